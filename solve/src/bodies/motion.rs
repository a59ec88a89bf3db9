//! The state of several bodies: as users give and get it, and with the parts lost to rounding, as steps carry it.

use fearless_simd::Level;

use super::{Bodies, Hold};
use crate::compensated::{Sum, two_sum};
use crate::so::{self, Mat, Vector};
use crate::state::State;
use crate::stepper::TurningMotion;

/// A state of a system of bodies.
#[derive(Clone, Debug, PartialEq)]
pub struct BodiesState<const N: usize> {
    /// The attitude of each body, from body to space coordinates.
    pub attitudes: Vec<Mat<N>>,
    /// The body momentum of each, skew, in kg m^2/s; with joints the momentum that belongs to its attitude.
    pub momenta: Vec<Mat<N>>,
    /// The place of each tree, in m: of a free one the centre of mass.
    pub places: Vec<Vector<N>>,
    /// Its linear momentum, in kg m/s; zero where it is fixed.
    pub linear_momenta: Vec<Vector<N>>,
}

/// Positions and velocities of a body that is free, or the root of a free tree.
#[derive(Clone, Debug, PartialEq)]
pub struct Start<const N: usize> {
    /// Attitude.
    pub attitude: Mat<N>,
    /// Body angular velocity, skew, in rad/s.
    pub angular_velocity: Mat<N>,
    /// Of the centre of mass, in m; of no effect unless [`Hold::Free`].
    pub position: Vector<N>,
    /// Of the centre of mass, in m/s; likewise.
    pub velocity: Vector<N>,
}

/// How a member of an ensemble starts, next to the state that it is a member of.
#[derive(Clone, Debug, PartialEq)]
pub struct Change<const N: usize> {
    /// theta, skew: the turn `exp(theta)` in body coordinates.
    pub turn: Mat<N>,
    /// delta, skew, in kg m^2/s: a change of the body's own momentum `J Omega`, in body coordinates.
    pub momentum: Mat<N>,
    /// s, of the centre of mass in m; of no effect unless [`Hold::Free`].
    pub shift: Vector<N>,
    /// v, of its velocity in m/s; likewise.
    pub velocity: Vector<N>,
}

impl<const N: usize> Bodies<N> {
    /// Returns the state that lies beside `state` by these changes. Joints hold, because places and momenta follow from
    /// attitudes and velocities:
    ///
    /// ```text
    /// g_a exp(theta_a),      Omega_a + J_a^-1 delta_a,      r_a + s_a  and  r_a' + v_a  of a free body a
    /// ```
    ///
    /// Without joints the second is `mu_a + delta_a`. `None` where `state` has no velocities.
    ///
    /// # Panics
    /// If there are not as many changes as bodies.
    pub fn beside(&self, state: &BodiesState<N>, changes: &[Change<N>]) -> Option<BodiesState<N>> {
        assert_eq!(changes.len(), self.bodies.len(), "one change for each body");
        let seen = self.seen(state)?;
        let starts: Vec<Start<N>> = seen
            .iter()
            .zip(changes)
            .enumerate()
            .map(|(a, (body, change))| Start {
                attitude: so::orthonormalised(&so::product(&body.attitude, &so::exp(&change.turn))),
                angular_velocity: body.angular_velocity + self.velocity_alone(a, &change.momentum),
                position: body.position + change.shift,
                velocity: body.velocity + change.velocity,
            })
            .collect();
        let mut beside = self.state(&starts);
        // Where nothing else has a part in them, the numbers of the state itself, not of velocities that follow from them.
        for (number, tree) in self.trees.iter().enumerate().filter(|(_, tree)| !tree.is_jointed()) {
            for &a in &tree.bodies {
                beside.momenta[a] = state.momenta[a] + changes[a].momentum;
            }
            if let Some(mass) = tree.mass_kg {
                let root = &changes[tree.bodies[0]];
                beside.places[number] = state.places[number] + root.shift;
                beside.linear_momenta[number] = state.linear_momenta[number] + root.velocity * mass;
            }
        }
        Some(beside)
    }

    /// Returns the state of bodies that start so.
    ///
    /// # Panics
    /// If there are not as many starts as bodies.
    pub fn state(&self, starts: &[Start<N>]) -> BodiesState<N> {
        assert_eq!(starts.len(), self.bodies.len(), "one start for each body");
        let attitudes: Vec<Mat<N>> = starts.iter().map(|start| start.attitude).collect();
        let velocities: Vec<Mat<N>> = starts.iter().map(|start| start.angular_velocity).collect();
        let momenta = self.momenta(&attitudes, &velocities);
        let (mut places, mut linear_momenta) = (self.fixed.clone(), Vec::new());
        for (tree, place) in self.trees.iter().zip(&mut places) {
            let Some(mass) = tree.mass_kg else {
                linear_momenta.push(Vector::zeros());
                continue;
            };
            let root = &starts[tree.bodies[0]];
            let (mut at, mut velocity) = (root.position, root.velocity);
            for (lever, &b) in tree.levers.first().into_iter().flatten().zip(&tree.bodies) {
                let turning = so::product(&attitudes[b], &velocities[b]);
                at -= so::to_space(&attitudes[b], lever);
                velocity -= so::to_space(&turning, lever);
            }
            *place = at;
            linear_momenta.push(velocity * mass);
        }
        BodiesState { attitudes, momenta, places, linear_momenta }
    }

    /// Is the body held at the origin of its coordinates?
    pub(super) fn is_pinned(&self, body: usize) -> bool {
        matches!(self.bodies[body].hold, Hold::Pivot(_))
    }
}

impl<const N: usize> BodiesState<N> {
    /// All its numbers, one after the other: matrices row by row.
    pub fn numbers(&self) -> Vec<f64> {
        let rows = |m: &Mat<N>| m.transpose().as_slice().to_vec();
        let vector = |v: &Vector<N>| v.as_slice().to_vec();
        let turning = self.attitudes.iter().chain(&self.momenta).flat_map(rows);
        turning.chain(self.places.iter().chain(&self.linear_momenta).flat_map(vector)).collect()
    }

    /// The state of such numbers, with as many bodies and trees as this one; `None` if there are more or fewer of them.
    pub fn with_numbers(&self, numbers: &[f64]) -> Option<Self> {
        let (k, m) = (self.attitudes.len(), self.places.len());
        if numbers.len() != 2 * k * N * N + 2 * m * N {
            return None;
        }
        let (turning, moving) = numbers.split_at(2 * k * N * N);
        let mut matrices = turning.chunks_exact(N * N).map(Mat::from_row_slice);
        let mut vectors = moving.chunks_exact(N).map(Vector::from_row_slice);
        Some(Self {
            attitudes: matrices.by_ref().take(k).collect(),
            momenta: matrices.collect(),
            places: vectors.by_ref().take(m).collect(),
            linear_momenta: vectors.collect(),
        })
    }
}

/// Sum of small changes of a vector.
#[derive(Clone, Debug)]
struct VectorSum<const N: usize>(Sum<Vector<N>>);

impl<const N: usize> VectorSum<N> {
    fn new(value: Vector<N>) -> Self {
        Self(Sum::new(value, Vector::zeros()))
    }

    fn add(&mut self, change: &Vector<N>) {
        let Sum { value, carry } = &mut self.0;
        for i in 0..N {
            (value[i], carry[i]) = two_sum(value[i], change[i] + carry[i]);
        }
    }
}

/// The motion of all bodies.
#[derive(Clone, Debug)]
pub(super) struct BodiesMotion<const N: usize> {
    turning: Vec<TurningMotion<N>>,
    places: Vec<VectorSum<N>>,
    linear_momenta: Vec<VectorSum<N>>,
}

impl<const N: usize> BodiesMotion<N> {
    pub(super) fn new(state: &BodiesState<N>) -> Self {
        let turning = state
            .attitudes
            .iter()
            .zip(&state.momenta)
            .map(|(&attitude, &momentum)| TurningMotion::new(&State { attitude, momentum }));
        let sums = |vectors: &[Vector<N>]| vectors.iter().copied().map(VectorSum::new).collect();
        Self {
            turning: turning.collect(),
            places: sums(&state.places),
            linear_momenta: sums(&state.linear_momenta),
        }
    }

    pub(super) fn attitude(&self, body: usize) -> &Mat<N> {
        self.turning[body].attitude()
    }

    pub(super) fn momentum(&self, body: usize) -> &Mat<N> {
        self.turning[body].body_momentum()
    }

    pub(super) fn place(&self, tree: usize) -> &Vector<N> {
        &self.places[tree].0.value
    }

    pub(super) fn linear_momentum(&self, tree: usize) -> &Vector<N> {
        &self.linear_momenta[tree].0.value
    }

    /// Turns a body by `I + turn`, and pushes it by `impulse`, both in the frame of its beginning; its body momentum gains
    /// `momentum_increment`.
    pub(super) fn turn(
        &mut self,
        level: Option<Level>,
        body: usize,
        changes: [&Mat<N>; 2],
        momentum_increment: &Mat<N>,
    ) {
        self.turning[body].advance(level, changes, Some(momentum_increment));
    }

    /// Moves a tree.
    pub(super) fn shift(&mut self, tree: usize, way: &Vector<N>, impulse: &Vector<N>) {
        self.places[tree].add(way);
        self.linear_momenta[tree].add(impulse);
    }

    pub(super) fn state(&self) -> BodiesState<N> {
        BodiesState {
            attitudes: self
                .turning
                .iter()
                .map(|motion| so::orthonormalised(motion.attitude()))
                .collect(),
            momenta: self.turning.iter().map(|motion| *motion.body_momentum()).collect(),
            places: self.places.iter().map(|sum| sum.0.value).collect(),
            linear_momenta: self.linear_momenta.iter().map(|sum| sum.0.value).collect(),
        }
    }
}
