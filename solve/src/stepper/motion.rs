//! State carried from step to step: attitude and momentum, and the part of each lost to rounding.
//!
//! Both VPD and Gauss collocation on quaternions carry it. Written for one body and for members side by side: `P` is a number
//! in memory, or one for each member.
//!
//! Invariant: only torques change the spatial momentum.

use crate::compensated::Sum;
use crate::hamiltonian::RigidBody;
use crate::lanes::{Row, StepScalar};
use crate::so3::Top;
use crate::space::{
    Quaternion, Vec3, cross, dot, mat3, minus, product, scaled, transposed_product, vec3,
};
use crate::state::State;

/// Square of the largest angle by which a momentum may be seen apart from its sum in the body for that to be rounding.
pub(super) const ROUNDING_SQUARE: f64 = 1e-28;

/// The motion of a body in three dimensions.
#[derive(Clone, Copy, Debug)]
pub(super) struct Motion<P> {
    /// A quaternion (w, v).
    pub(super) attitude: Sum<[P; 4]>,
    /// Spatial momentum.
    pub(super) momentum: Sum<[P; 3]>,
    /// Body momentum; with one or two stages, and for a free body, `g^T pi` and no sum.
    pub(super) body_momentum: Sum<[P; 3]>,
}

impl<P: Copy> Motion<P> {
    /// Creates a motion at rest, not turned.
    pub(super) fn blank(zero: P, one: P) -> Self {
        Self {
            attitude: Sum::new([one, zero, zero, zero], [zero; 4]),
            momentum: Sum::new([zero; 3], [zero; 3]),
            body_momentum: Sum::new([zero; 3], [zero; 3]),
        }
    }

    /// Writes the space vectors of the potential, as they are seen from here, to `seen`.
    #[inline(always)]
    pub(super) fn space_vectors<W: StepScalar<Storage = P>>(
        &self,
        lanes: W,
        body: &RigidBody<3>,
        seen: &mut Vec<Vec3<P>>,
    ) {
        let g = load_turn(lanes, &self.attitude.value).matrix();
        seen.clear();
        for v in body.space_vectors() {
            let v = transposed_product(&g, &vec3!(i => lanes.constant(v[i])));
            let mut plain = self.momentum.value;
            for i in 0..3 {
                v[i].store(&mut plain[i]);
            }
            seen.push(plain);
        }
    }

    /// Advances by a step that turns by `end` and pushes by `impulse`, both in the frame of its
    /// beginning; the body momentum is not updated.
    #[inline(always)]
    pub(super) fn advance<W: StepScalar<Storage = P>>(
        &mut self,
        lanes: W,
        end: &Quaternion<P>,
        impulse: &Vec3<P>,
    ) {
        let start = load_turn(lanes, &self.attitude.value);
        self.momentum.add(&product(&start.matrix(), &vec3!(i => lanes.load(&impulse[i]))));
        // The quaternion of the rotation that is close to one: f - 1, with 1 - w = |v|^2 / (1 + w)
        let end_w = lanes.load(&end.w);
        let one = lanes.constant(1.0);
        let sign = one.select(-end_w, 0.0, -one);
        let v: Vec3<W> = vec3!(i => lanes.load(&end.v[i]) * sign);
        let change = Quaternion { w: -dot(&v, &v) / (sign * end_w + 1.0), v };
        // The carried part turns along.
        let carried = load_turn(lanes, &self.attitude.carry).times(&change);
        let change = start.times(&change);
        // The error of the norm, each square subtracted from one: a sum next to one is
        // rounded twice as far from above as from below. The norm would keep a bias, and the
        // momentum in the body with it.
        let Quaternion { w, v: [x, y, z] } = start;
        let norm_error = ((((one - w * w) - x * x) - y * y) - z * z) * 0.5;
        self.attitude.add(&[
            change.w + (carried.w + norm_error * start.w),
            change.v[0] + (carried.v[0] + norm_error * start.v[0]),
            change.v[1] + (carried.v[1] + norm_error * start.v[1]),
            change.v[2] + (carried.v[2] + norm_error * start.v[2]),
        ]);
    }

    /// The body momentum is the spatial one, seen from the body: `g^T pi`.
    #[inline(always)]
    pub(super) fn turn_momentum<W: StepScalar<Storage = P>>(&mut self, lanes: W) {
        let g = load_turn(lanes, &self.attitude.value).matrix();
        let seen = transposed_product(&g, &vec3!(i => lanes.load(&self.momentum.value[i])));
        for i in 0..3 {
            seen[i].store(&mut self.body_momentum.value[i]);
        }
    }

    /// Adds `momentum_increment` to the body momentum, and turns the attitude so that rounding does not separate
    /// the spatial momentum, which only torques change, from the body momentum, whose direction is
    /// the more precise: `g <- g (I + hat(theta))` with `theta = (p - g^T pi) x p / |p|^2`, and
    /// less where the step has added more than there is. The direction of the momentum of a body almost at
    /// rest is made of rounding errors: it turns nothing.
    ///
    /// The lengths of the two are left as they are: giving the body momentum the length of the
    /// other would take from all its components what rounding has put into some, and the energy of
    /// a heavy top grew in a line by that.
    #[inline(always)]
    pub(super) fn add_momentum_increment<W: StepScalar<Storage = P>>(
        &mut self,
        lanes: W,
        momentum_increment: &Vec3<P>,
    ) {
        let momentum_increment = vec3!(i => lanes.load(&momentum_increment[i]));
        self.body_momentum.add(&momentum_increment);
        let now = load_turn(lanes, &self.attitude.value);
        let [momentum, pi] = [&self.body_momentum, &self.momentum]
            .map(|sum| -> Vec3<W> { vec3!(i => lanes.load(&sum.value[i])) });
        let seen = transposed_product(&now.matrix(), &pi);
        let square = dot(&seen, &seen) + dot(&momentum_increment, &momentum_increment);
        let square = square.max_or_nan(lanes.constant(f64::MIN_POSITIVE));
        let apart = minus(&momentum, &seen);
        let scale = lanes.constant(0.5) / square;
        let scale =
            scale.select(dot(&apart, &apart) / square, ROUNDING_SQUARE, lanes.constant(0.0));
        let half = scaled(&cross(&apart, &seen), scale);
        // The turn is tiny: it is added at the next step.
        let Quaternion { w, v: [x, y, z] } = now.rate(&half);
        for (carry, change) in self.attitude.carry.iter_mut().zip([w, x, y, z]) {
            (lanes.load(carry) + change).store(carry);
        }
    }
}

impl Motion<f64> {
    /// Begins at `state`.
    pub(super) fn of(state: &State<3>) -> Self {
        let Top { attitude: q, momentum } = Top::from_state(state);
        let g = mat3!(i, j => state.attitude[(i, j)]);
        let begun = |numbers| Sum::new(unsigned_zeros(numbers), [0.0; 3]);
        Self {
            attitude: Sum::new(unsigned_zeros([q.w, q.i, q.j, q.k]), [0.0; 4]),
            momentum: begun(product(&g, &momentum.into())),
            body_momentum: begun(momentum.into()),
        }
    }

    pub(super) fn is_finite(&self) -> bool {
        let Self { attitude, momentum, body_momentum } = self;
        let numbers = attitude.value.iter().chain(&momentum.value).chain(&body_momentum.value);
        numbers.into_iter().all(|x| x.is_finite())
    }

    pub(super) fn quaternion(&self) -> Quaternion<f64> {
        load_turn(0.0, &self.attitude.value)
    }
}

impl Motion<Row> {
    /// Takes in a member.
    pub(super) fn take(&mut self, lane: usize, member: &Motion<f64>) {
        let Motion { attitude, momentum, body_momentum } = member;
        self.attitude.take(lane, attitude);
        self.momentum.take(lane, momentum);
        self.body_momentum.take(lane, body_momentum);
    }

    /// A member.
    pub(super) fn member(&self, lane: usize) -> Motion<f64> {
        let Self { attitude, momentum, body_momentum } = self;
        Motion {
            attitude: attitude.member(lane),
            momentum: momentum.member(lane),
            body_momentum: body_momentum.member(lane),
        }
    }
}

/// Removes the sign of zeros: a lane without a stage adds a zero of either sign. Sums that begin
/// with these have none, either.
pub(super) fn unsigned_zeros<const K: usize>(numbers: [f64; K]) -> [f64; K] {
    numbers.map(|x| x + 0.0)
}

#[inline(always)]
fn load_turn<W: StepScalar>(lanes: W, [w, x, y, z]: &[W::Storage; 4]) -> Quaternion<W> {
    Quaternion { w: lanes.load(w), v: [lanes.load(x), lanes.load(y), lanes.load(z)] }
}
