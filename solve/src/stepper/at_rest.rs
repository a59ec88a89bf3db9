//! A body that starts at rest where nothing pushes: it stays.
//!
//! Invariant: the state is kept to the bit where neither momentum nor torque is anything but zero at the start. From
//! elsewhere, as a study may start it, the body goes the way of the method.

use super::Stepper;
use crate::failure::Failure;
use crate::hamiltonian::RigidBody;
use crate::nonlinear::Convergence;
use crate::so::Mat;
use crate::state::State;

/// The stepper: the state that is kept, and the method for any other.
pub struct AtRest<const N: usize> {
    method: Box<dyn Stepper<N>>,
    state: State<N>,
    /// Whether it stays; not yet known before the first step.
    stays: Option<bool>,
}

impl<const N: usize> AtRest<N> {
    /// Creates a stepper that keeps a state at rest, and carries others forward by `method`.
    pub fn new(method: Box<dyn Stepper<N>>) -> Self {
        let state = State { attitude: Mat::identity(), momentum: Mat::zeros() };
        Self { method, state, stays: None }
    }

    fn moves(&self) -> bool {
        self.stays == Some(false)
    }
}

impl<const N: usize> Stepper<N> for AtRest<N> {
    fn order(&self) -> u32 {
        self.method.order()
    }

    fn start(&mut self, state: &State<N>) {
        self.method.start(state);
        (self.state, self.stays) = (state.clone(), None);
    }

    fn step(&mut self, body: &RigidBody<N>, h: f64) -> Result<Convergence, Failure> {
        let State { attitude, momentum } = &self.state;
        let nothing = |x: &Mat<N>| x.iter().all(|&x| x == 0.0);
        let stays = || nothing(momentum) && nothing(&body.gradient(attitude));
        if *self.stays.get_or_insert_with(stays) {
            body.work().begin_sweep()?;
            Ok(Convergence::EXPLICIT)
        } else {
            self.method.step(body, h)
        }
    }

    fn attitude(&self) -> Option<Mat<N>> {
        if self.moves() { self.method.attitude() } else { Some(self.state.attitude) }
    }

    fn momentum(&self) -> Mat<N> {
        if self.moves() { self.method.momentum() } else { self.state.momentum }
    }

    fn sigma_min(&self) -> Option<f64> {
        // P is I for a step that does not turn.
        if self.moves() { self.method.sigma_min() } else { self.method.sigma_min().map(|_| 1.0) }
    }
}
