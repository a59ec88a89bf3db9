//! Splitting of H = T + U for n = 3: the exact free top between kicks of the potential.
//!
//! ```text
//! S_h = K_{h/2} o E_h o K_{h/2}      K_h: mu += -h dH/dg,      E_h: the free body, solved exactly
//! ```
//!
//! Strang (1968), and symmetric compositions of it to 4th, 6th and 8th order: see
//! [`crate::composition`]. The free top: [`crate::free_top`].
//!
//! Invariant: symplectic and symmetric; both flows are exact to round-off, so a free body is exact and the
//! spatial momentum along the symmetries of the potential is kept to round-off.

use nalgebra::{Matrix3, Quaternion, Vector3};

use super::explicit_stages::{End, Law, NUMBERS};
use super::so3_equations::Inertia;
use crate::compensated::two_sum;
use crate::composition::{Composition, Drift, TopSum};
use crate::failure::Failure;
use crate::free_top;
use crate::free_top::short::{ShortFlow, on_orbit, short_flow};
use crate::hamiltonian::RigidBody;
use crate::lanes::{Real, StageScalar, StepScalar};
use crate::nonlinear::Convergence;
use crate::so::{Mat, Vector};
use crate::so3::{self, Top};
use crate::space::{self, Vec3, dot, plus, product, scaled, transposed_product, vec3};
use crate::state::State;
use crate::stepper::Stepper;

/// The stepper: a composition and its data of the body.
#[derive(Clone, Debug)]
pub struct Splitting {
    pub(super) composition: Composition,
    pub(super) state: TopSum,
    /// The axes of the last body seen.
    axes: PrincipalAxes,
    seen: Vec<Vector<3>>,
}

impl Splitting {
    /// Creates a stepper of order 2 (Strang), 4, 6 or 8; `None` for any other order.
    pub fn new(order: u32) -> Option<Self> {
        Some(Self {
            composition: Composition::new(order)?,
            state: Top::at_rest().into(),
            axes: PrincipalAxes::of(&Matrix3::identity()),
            seen: Vec::new(),
        })
    }

    /// Finds the principal axes of a body, unless it is the last one.
    pub(super) fn see(&mut self, body: &RigidBody<3>) {
        let inverse = body.inverse_inertia();
        if inverse != self.axes.tensor {
            self.axes = PrincipalAxes::of(&inverse);
        }
    }

    /// The step in vectors: see `explicit_so3`.
    #[inline(always)]
    pub(super) fn in_vectors<R: StageScalar, const EXTRAS: u8>(
        &self,
        law: &mut Law<'_, R>,
        h: f64,
        state: &[R; NUMBERS],
    ) -> End<R> {
        let zero = state[0].constant(0.0);
        let mut sum = *state;
        let (mut doubt, mut before) = (zero + -1.0, 0.0);
        for &part in self.composition.parts() {
            let of_kick = kick::<R, EXTRAS>(law, 0.5 * h * (before + part), &mut sum);
            let [_, _, _, _, x, y, z, ..] = sum;
            let ShortFlow { turn, momentum_increment, doubt: of_drift } =
                self.axes.short_flow(&[x, y, z], h * part, law.inertia());
            turn_by(&mut sum, &turn);
            push(&mut sum, &momentum_increment);
            doubt = doubt.max_or_nan(of_kick).max_or_nan(of_drift);
            // Of one body the rest is not needed.
            if R::LANES == 1 && !(doubt.stage(0).lane(0) < 0.0) {
                break;
            }
            before = part;
        }
        let of_kick = kick::<R, EXTRAS>(law, 0.5 * h * before, &mut sum);
        End { state: sum, doubt: doubt.max_or_nan(of_kick) }
    }
}

/// Adds an impulse of the potential during `h` to a sum; returns its doubt.
#[inline(always)]
fn kick<R: StageScalar, const EXTRAS: u8>(law: &Law<'_, R>, h: f64, sum: &mut [R; NUMBERS]) -> R {
    let [w, x, y, z, ..] = *sum;
    let attitude = space::Quaternion { w, v: [x, y, z] };
    let (torque, doubt) = law.torque::<EXTRAS>(&attitude.normalised().matrix());
    push(sum, &scaled(&torque, w.constant(-h)));
    doubt
}

/// Adds to the body momentum of a sum, which is `[q, mu]` and what is still to be added to it.
#[inline(always)]
fn push<R: Real>(sum: &mut [R; NUMBERS], impulse: &Vec3<R>) {
    for i in 0..3 {
        (sum[4 + i], sum[11 + i]) = two_sum(sum[4 + i], impulse[i] + sum[11 + i]);
    }
}

/// `q1 = q0 + q0 (f - 1)`, and the deficit of its length from one.
#[inline(always)]
fn turn_by<R: Real>(sum: &mut [R; NUMBERS], turn: &space::Quaternion<R>) {
    let one = turn.w.constant(1.0);
    // The quaternion of the rotation that is close to one, with 1 - w = |v|^2 / (1 + w).
    let sign = one.select(-turn.w, 0.0, -one);
    let v = scaled(&turn.v, sign);
    let small = space::Quaternion { w: -dot(&v, &v) / (sign * turn.w + 1.0), v };
    let [w, x, y, z, _, _, _, carried_w, carried_x, carried_y, carried_z, ..] = *sum;
    let attitude = space::Quaternion { w, v: [x, y, z] };
    let carried = space::Quaternion { w: carried_w, v: [carried_x, carried_y, carried_z] };
    let norm_error = attitude.square() * -0.5 + 0.5;
    let (change, turned) = (attitude.times(&small), carried.times(&small));
    let changes = [
        change.w + (carried.w + turned.w + attitude.w * norm_error),
        change.v[0] + (carried.v[0] + turned.v[0] + attitude.v[0] * norm_error),
        change.v[1] + (carried.v[1] + turned.v[1] + attitude.v[1] * norm_error),
        change.v[2] + (carried.v[2] + turned.v[2] + attitude.v[2] * norm_error),
    ];
    for i in 0..4 {
        (sum[i], sum[7 + i]) = two_sum(sum[i], changes[i]);
    }
}

impl Stepper<3> for Splitting {
    fn order(&self) -> u32 {
        self.composition.order()
    }

    fn start(&mut self, state: &State<3>) {
        self.state = Top::from_state(state).into();
    }

    fn step(&mut self, body: &RigidBody<3>, h: f64) -> Result<Convergence, Failure> {
        self.see(body);
        let axes = &self.axes;
        let (state, _) = self.composition.step(body, &mut self.seen, self.state, h, |top, h| {
            let (drift, pieces) = axes.free(top, h).ok_or(Failure::not_finite(None))?;
            body.work().add_pieces(pieces);
            Ok((drift, Convergence::EXPLICIT))
        })?;
        self.state = state;
        Ok(Convergence::EXPLICIT)
    }

    fn attitude(&self) -> Option<Mat<3>> {
        Some(so3::rotation(&self.state.top.attitude))
    }

    fn momentum(&self) -> Mat<3> {
        so3::hat(&self.state.top.momentum)
    }
}

/// `J^-1 = R diag(w) R^T`.
#[derive(Clone, Debug)]
pub(crate) struct PrincipalAxes {
    tensor: Matrix3<f64>,
    inverse: Vector3<f64>,
    /// R, from principal to body axes; `None` where they are the same.
    turn: Option<Quaternion<f64>>,
}

impl PrincipalAxes {
    /// Diagonalises the tensor by Jacobi's rotations: each takes one product of inertia away; four
    /// rounds reach round-off.
    pub(crate) fn of(tensor: &Matrix3<f64>) -> Self {
        let (mut d, mut r) = (*tensor, Matrix3::identity());
        for _ in 0..8 {
            for (i, j) in [(0, 1), (1, 2), (0, 2)] {
                if d[(i, j)] == 0.0 {
                    continue;
                }
                // The smaller root t = tan of t^2 + 2 t (d_jj - d_ii) / (2 d_ij) = 1.
                let ratio = (d[(j, j)] - d[(i, i)]) / (2.0 * d[(i, j)]);
                let t = 1.0_f64.copysign(ratio) / (ratio.abs() + (1.0 + ratio * ratio).sqrt());
                let c = 1.0 / (1.0 + t * t).sqrt();
                let mut plane = Matrix3::identity();
                (plane[(i, i)], plane[(j, j)]) = (c, c);
                (plane[(i, j)], plane[(j, i)]) = (c * t, -c * t);
                d = plane.transpose() * d * plane;
                (d[(i, j)], d[(j, i)]) = (0.0, 0.0);
                r *= plane;
            }
        }
        let turn = (r != Matrix3::identity()).then(|| so3::unit(&r));
        Self { tensor: *tensor, inverse: d.diagonal(), turn }
    }

    /// A short motion of the free body in vectors, whose inertia is given.
    #[inline(always)]
    fn short_flow<R: StageScalar>(
        &self,
        mu: &Vec3<R>,
        h: f64,
        inertia: &Inertia<R>,
    ) -> ShortFlow<R> {
        let Some(turn) = self.turn else {
            return short_flow(&self.inverse, mu, h);
        };
        let [x, y, z, w] = turn.coords.into();
        let (w, v) = (mu[0].constant(w), vec3!(i => mu[0].constant([x, y, z][i])));
        let turn = space::Quaternion { w, v };
        let back = space::Quaternion { w, v: scaled(&v, mu[0].constant(-1.0)) };
        let axes = turn.matrix();
        let ShortFlow { turn: f, momentum_increment, doubt } =
            short_flow(&self.inverse, &transposed_product(&axes, mu), h);
        let gain = product(&axes, &momentum_increment);
        let of_end = inertia.divides(&plus(mu, &gain));
        let of_both = inertia.divides(&plus(&plus(mu, mu), &gain));
        let momentum_increment = on_orbit(mu, &gain, &of_end, &of_both);
        ShortFlow { turn: turn.times(&f).times(&back), momentum_increment, doubt }
    }

    pub(crate) fn free(&self, top: &Top, h: f64) -> Option<(Drift, f64)> {
        let Some(turn) = self.turn else {
            return free_top::flow(&self.inverse, &top.momentum, h);
        };
        let rotate = |q: &Quaternion<f64>, v: &Vector3<f64>| {
            Vector3::from((*q * so3::pure(v) * q.conjugate()).vector())
        };
        let principal = rotate(&turn.conjugate(), &top.momentum);
        let (Drift { turn: f, momentum_increment }, pieces) =
            free_top::flow(&self.inverse, &principal, h)?;
        let momentum_increment =
            free_top::on_orbit(&self.tensor, &top.momentum, rotate(&turn, &momentum_increment));
        Some((Drift { turn: turn * f * turn.conjugate(), momentum_increment }, pieces))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn principal_axes_of_a_tensor() {
        let tensor = Matrix3::new(2.0, 0.3, -0.1, 0.3, 1.0, 0.2, -0.1, 0.2, 5.0);
        let axes = PrincipalAxes::of(&tensor);
        let r = so3::rotation(&axes.turn.expect("a turned frame"));
        assert!(
            (r * Matrix3::from_diagonal(&axes.inverse) * r.transpose() - tensor).amax() < 5e-15
        );
        let diagonal = Matrix3::from_diagonal(&Vector3::new(3.0, 1.0, 2.0));
        assert_eq!(PrincipalAxes::of(&diagonal).turn, None);
    }
}
