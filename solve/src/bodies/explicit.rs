//! Explicit Runge-Kutta for several bodies, the baseline: the attitudes as matrices that are projected to the group after each
//! step, or in the Lie algebra by exp (Munthe-Kaas 1999, Applied Numerical Mathematics 29), as [`crate::stepper::rk`]
//! and [`crate::stepper::rkmk`] for one.
//!
//! ```text
//! g' = g Omega      mu' = [mu, Omega] - dH/dg      x' = p / M      p' = -dH/dx
//! ```
//!
//! Invariant: momenta are skew; attitudes are on the group to round-off.

use super::trajectory::BodiesStepper;
use super::{Bodies, BodiesState, Configuration, Forces};
use crate::failure::{Failure, FailureCode};
use crate::nonlinear::Convergence;
use crate::so::{self, Mat, Vector};
use crate::tableau::Tableau;

/// How an explicit scheme treats attitudes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Attitudes {
    /// As matrices, projected to the group after each step by their polar factor.
    Projected,
    /// In the Lie algebra.
    Lie,
}

/// The stepper.
#[derive(Clone, Debug)]
pub struct BodiesRk<const N: usize> {
    tableau: Tableau,
    order: u32,
    kind: Attitudes,
    state: BodiesState<N>,
    rates: Vec<Rates<N>>,
    forces: Forces<N>,
}

/// The rates of change at a stage.
#[derive(Clone, Debug)]
struct Rates<const N: usize> {
    /// `g Omega`, or the rate in the Lie algebra.
    attitudes: Vec<Mat<N>>,
    momenta: Vec<Mat<N>>,
    places: Vec<Vector<N>>,
    linear_momenta: Vec<Vector<N>>,
}

impl<const N: usize> BodiesRk<N> {
    /// Creates a stepper for an explicit tableau, for systems of as many bodies and trees as `state`; `None` for any other
    /// tableau.
    pub fn new(tableau: Tableau, kind: Attitudes, state: &BodiesState<N>) -> Option<Self> {
        let (bodies, trees) = (state.attitudes.len(), state.places.len());
        let rates = Rates {
            attitudes: vec![Mat::zeros(); bodies],
            momenta: vec![Mat::zeros(); bodies],
            places: vec![Vector::zeros(); trees],
            linear_momenta: vec![Vector::zeros(); trees],
        };
        tableau.is_explicit().then(|| Self {
            rates: vec![rates; tableau.stages()],
            // Looked up once: it is found from the trees of the order conditions.
            order: tableau.classical_order(),
            tableau,
            kind,
            state: state.clone(),
            forces: Forces::none(bodies, trees),
        })
    }

    /// The state after the given parts of the rates of the first `count` stages, and the turns in the Lie algebra.
    fn at(&self, count: usize, part: impl Fn(usize) -> f64) -> (BodiesState<N>, Vec<Mat<N>>) {
        let mut state = self.state.clone();
        let mut turns = vec![Mat::zeros(); state.attitudes.len()];
        for (j, rates) in self.rates.iter().enumerate().take(count) {
            let part = part(j);
            if part == 0.0 {
                continue;
            }
            turns.iter_mut().zip(&rates.attitudes).for_each(|(x, rate)| *x += rate * part);
            state.momenta.iter_mut().zip(&rates.momenta).for_each(|(x, rate)| *x += rate * part);
            state.places.iter_mut().zip(&rates.places).for_each(|(x, rate)| *x += rate * part);
            let momenta = state.linear_momenta.iter_mut().zip(&rates.linear_momenta);
            momenta.for_each(|(x, rate)| *x += rate * part);
        }
        for (g, turn) in state.attitudes.iter_mut().zip(&turns) {
            match self.kind {
                Attitudes::Lie => *g = so::product(g, &so::exp(turn)),
                Attitudes::Projected => *g += turn,
            }
        }
        (state, turns)
    }

    /// `dexpinv(sigma, Omega) = Omega + [sigma, Omega] / 2 + [sigma, [sigma, Omega]] / 12 - ...`
    fn dexpinv(&self, sigma: &Mat<N>, omega: &Mat<N>) -> Mat<N> {
        let (mut nested, mut sum) = (*omega, *omega);
        let terms = self.order.saturating_sub(2) as usize;
        for coefficient in crate::stepper::rkmk::DEXPINV.iter().take(terms) {
            nested = so::asym(&so::product(sigma, &nested));
            if *coefficient != 0.0 {
                sum += nested * *coefficient;
            }
        }
        sum
    }
}

impl<const N: usize> BodiesStepper<N> for BodiesRk<N> {
    fn order(&self) -> u32 {
        self.order
    }

    fn start(&mut self, state: &BodiesState<N>) {
        self.state = state.clone();
    }

    fn step(&mut self, bodies: &Bodies<N>, h: f64) -> Result<Convergence, Failure> {
        bodies.work().begin_sweep()?;
        let stages = self.tableau.stages();
        let mut velocities = vec![Mat::zeros(); self.state.attitudes.len()];
        for i in 0..stages {
            let (state, turns) = self.at(i, |j| h * self.tableau.a(i, j));
            let at_stage = |failure: Failure| Failure { stage: Some(i), ..failure };
            let BodiesState { attitudes, momenta, places, linear_momenta } = &state;
            bodies.velocities(attitudes, momenta, &mut velocities).map_err(at_stage)?;
            let at = Configuration { attitudes, places, velocities: &velocities };
            bodies.forces(at, &mut self.forces).map_err(at_stage)?;
            bodies.work().add_gradients(1);
            for (a, omega) in velocities.iter().enumerate() {
                let (g, mu) = (&attitudes[a], &momenta[a]);
                let rate = match self.kind {
                    Attitudes::Lie => self.dexpinv(&turns[a], omega),
                    Attitudes::Projected => so::product(g, omega),
                };
                // [mu, Omega] = asym(mu Omega)
                let torque = so::conjugate(&g.transpose(), &self.forces.torques[a]);
                self.rates[i].attitudes[a] = rate;
                self.rates[i].momenta[a] = so::asym(&so::product(mu, omega)) + so::skew(&torque);
            }
            for (tree, p) in linear_momenta.iter().enumerate() {
                let Some(mass) = bodies.mass_of_place(tree) else { continue };
                self.rates[i].places[tree] = p / mass;
                self.rates[i].linear_momenta[tree] = self.forces.forces[tree];
            }
        }
        let (mut end, _) = self.at(stages, |j| h * self.tableau.b(j));
        let left = Failure::new(FailureCode::LeftGlPlus, None, 0.0, 0.0);
        for g in &mut end.attitudes {
            *g = match self.kind {
                Attitudes::Projected => so::polar(g).ok_or(left.clone())?,
                Attitudes::Lie => so::orthonormalised(g),
            };
        }
        if end.numbers().iter().any(|x| !x.is_finite()) {
            return Err(Failure::not_finite(None));
        }
        self.state = end;
        Ok(Convergence::EXPLICIT)
    }

    fn state(&self) -> BodiesState<N> {
        self.state.clone()
    }
}
