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

use crate::composition::{Composition, Drift, TopSum};
use crate::failure::Failure;
use crate::free_top;
use crate::hamiltonian::RigidBody;
use crate::nonlinear::Convergence;
use crate::so::{Mat, Vector};
use crate::so3::{self, Top};
use crate::state::State;
use crate::stepper::Stepper;

/// The stepper: a composition and its data of the body.
#[derive(Clone, Debug)]
pub struct Splitting {
    composition: Composition,
    state: TopSum,
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
}

impl Stepper<3> for Splitting {
    fn order(&self) -> u32 {
        self.composition.order()
    }

    fn start(&mut self, state: &State<3>) {
        self.state = Top::from_state(state).into();
    }

    fn step(&mut self, body: &RigidBody<3>, h: f64) -> Result<Convergence, Failure> {
        let inverse = body.inverse_inertia();
        if inverse != self.axes.tensor {
            self.axes = PrincipalAxes::of(&inverse);
        }
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
