//! A stepper that carries the derivatives of its state along.

use super::dense::add_scaled;
use super::{Tangent, TangentError};
use crate::failure::{Failure, FailureCode};
use crate::hamiltonian::{BodyRate, RigidBody};
use crate::nonlinear::Convergence;
use crate::so::{self, Mat};
use crate::state::{Checkpoint, Derivatives, State};
use crate::stepper::{Clock, Stepper};
use crate::tableau::Tableau;

/// A parameter of a run, by the rates at which body and start change with it.
#[derive(Clone, Debug, PartialEq)]
pub struct Parameter<const N: usize> {
    /// The rate of the body.
    pub body: BodyRate<N>,
    /// The rate of the body momentum at the start, skew.
    pub start: Mat<N>,
}

/// What is uncertain: changes of one standard deviation each, of independent normal numbers.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Uncertainty {
    /// Of the start, (xi, nu) of 2d numbers one after another: the columns of a factor C of its covariance C C^T.
    pub start: Vec<f64>,
    /// Standard deviation of each parameter; zero for those that are not in it.
    pub parameters: Vec<f64>,
}

/// A stepper of VPD whose steps also carry the derivatives of the state by the start and by parameters. The states are those
/// of the stepper inside, to the bit.
pub struct WithDerivatives<const N: usize> {
    stepper: Box<dyn Stepper<N>>,
    tangent: Tangent<N>,
    rates: Vec<BodyRate<N>>,
    at_start: Derivatives,
    derivatives: Derivatives,
    uncertainty: Option<Uncertainty>,
    /// Room for the stages of a step, and for a transition matrix.
    stages: Vec<State<N>>,
    carried: Vec<f64>,
}

impl<const N: usize> WithDerivatives<N> {
    /// Carries the derivatives of `body` along, by the state at the start if `by_state`, and by parameters, for a stepper of
    /// VPD with this tableau.
    ///
    /// # Errors
    /// Those of [`Tangent::new`].
    pub fn new(
        stepper: Box<dyn Stepper<N>>,
        body: &RigidBody<N>,
        tableau: Tableau,
        by_state: bool,
        parameters: Vec<Parameter<N>>,
    ) -> Result<Self, TangentError> {
        let tangent = Tangent::new(body, tableau)?;
        let d = so::dimension(N);
        let mut at_start = Derivatives::default();
        if by_state {
            let one = |k| if k % (2 * d + 1) == 0 { 1.0 } else { 0.0 };
            at_start.transition.extend((0..4 * d * d).map(one));
        }
        for Parameter { start, .. } in &parameters {
            at_start.sensitivity.extend(std::iter::repeat_n(0.0, d));
            at_start.sensitivity.extend(so::vee(start));
        }
        let rates = parameters.into_iter().map(|parameter| parameter.body).collect();
        let derivatives = at_start.clone();
        let (stages, carried) = (Vec::new(), Vec::new());
        let uncertainty = None;
        Ok(Self { stepper, tangent, rates, at_start, derivatives, uncertainty, stages, carried })
    }

    /// Gives the derivatives the covariance that follows from that of the start and of the parameters. That of the start needs
    /// the derivatives by the state.
    #[must_use]
    pub fn with_uncertainty(self, uncertainty: Uncertainty) -> Self {
        Self { uncertainty: Some(uncertainty), ..self }
    }

    /// The covariance to first order, of the changes c_i of the start and the parameters with deviation s_k:
    ///
    /// ```text
    /// P = sum_i (M c_i) (M c_i)^T + sum_k s_k^2 S_k S_k^T
    /// ```
    fn covariance(&self, uncertainty: &Uncertainty) -> Vec<f64> {
        let rows = 2 * so::dimension(N);
        let Derivatives { transition, sensitivity, .. } = &self.derivatives;
        let mut sum = vec![0.0; rows * rows];
        let mut add = |change: &[f64]| {
            for (row, x) in sum.chunks_exact_mut(rows).zip(change) {
                add_scaled(row, change, *x);
            }
        };
        for change in uncertainty.start.chunks_exact(rows) {
            let products = transition.chunks_exact(rows);
            let carried = products.map(|row| row.iter().zip(change).map(|(a, b)| a * b).sum());
            add(&carried.collect::<Vec<f64>>());
        }
        for (column, deviation) in sensitivity.chunks_exact(rows).zip(&uncertainty.parameters) {
            add(&column.iter().map(|x| deviation * x).collect::<Vec<f64>>());
        }
        sum
    }

    fn state(&self) -> State<N> {
        let attitude = self.stepper.attitude().unwrap_or_else(Mat::identity);
        State { attitude, momentum: self.stepper.momentum() }
    }

    /// Multiplies the derivatives by those of the step that was made from `before`.
    fn carry(&mut self, h: f64, before: &State<N>) -> Result<(), Failure> {
        self.stages.clear();
        self.stages.extend((0..).map_while(|k| self.stepper.stage(k)));
        let of_step =
            self.tangent.of_step(h, before, &self.stages).map_err(|error| match error {
                TangentError::Step(failure) => failure,
                // The pivot is zero to working precision.
                TangentError::Driven | TangentError::UserPotential | TangentError::Singular => {
                    Failure::new(FailureCode::LyapunovSingular, None, 0.0, f64::EPSILON)
                }
            })?;
        let rows = 2 * so::dimension(N);
        let Derivatives { transition, sensitivity, .. } = &mut self.derivatives;
        if !transition.is_empty() {
            self.carried.clear();
            self.carried.resize(rows * rows, 0.0);
            let sums = self.carried.chunks_exact_mut(rows);
            for (sum, step) in sums.zip(of_step.transition().chunks_exact(rows)) {
                for (x, row) in step.iter().zip(transition.chunks_exact(rows)) {
                    add_scaled(sum, row, *x);
                }
            }
            std::mem::swap(transition, &mut self.carried);
        }
        let by_parameters = of_step.by_parameters(&self.rates);
        let columns = sensitivity.chunks_exact_mut(rows).zip(by_parameters.chunks_exact(rows));
        for (column, by_parameter) in columns {
            let carried = of_step.push_forward(column);
            let sums = column.iter_mut().zip(carried.iter().zip(by_parameter));
            sums.for_each(|(sum, (carried, by_parameter))| *sum = carried + by_parameter);
        }
        Ok(())
    }
}

impl<const N: usize> Stepper<N> for WithDerivatives<N> {
    fn order(&self) -> u32 {
        self.stepper.order()
    }

    fn start(&mut self, state: &State<N>) {
        self.stepper.start(state);
        self.derivatives.clone_from(&self.at_start);
    }

    fn resume(&mut self, checkpoint: &Checkpoint<N>) {
        self.start(&checkpoint.state());
        self.stepper.resume(checkpoint);
        if let Some(derivatives) = &checkpoint.derivatives {
            self.derivatives.clone_from(derivatives);
        }
    }

    fn step(&mut self, body: &RigidBody<N>, h: f64) -> Result<Convergence, Failure> {
        let before = self.state();
        let solved = self.stepper.step(body, h)?;
        self.carry(h, &before).inspect_err(|_| self.stepper.start(&before))?;
        Ok(solved)
    }

    fn derivatives(&self) -> Option<Derivatives> {
        let covariance = self.uncertainty.as_ref().map(|given| self.covariance(given));
        Some(Derivatives { covariance: covariance.unwrap_or_default(), ..self.derivatives.clone() })
    }

    fn clock(&self) -> Option<&Clock<N>> {
        self.stepper.clock()
    }

    fn clock_mut(&mut self) -> Option<&mut Clock<N>> {
        self.stepper.clock_mut()
    }

    fn attitude(&self) -> Option<Mat<N>> {
        self.stepper.attitude()
    }

    fn momentum(&self) -> Mat<N> {
        self.stepper.momentum()
    }

    fn sigma_min(&self) -> Option<f64> {
        self.stepper.sigma_min()
    }

    fn stage(&self, k: usize) -> Option<State<N>> {
        self.stepper.stage(k)
    }
}
