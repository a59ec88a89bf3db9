//! The fields by which a run is differentiated, as rates of the model.

use nalgebra::DMatrix;
use serde_json::{Value, json};

use super::Plan;
use super::model::{inertia_matrix, momentum, with_matrix};
use super::problem::term;
use crate::scenario::{Scenario, from_tree, semidefinite, set};
use crate::solve::hamiltonian::{BodyRate, Term};
use crate::solve::so::{self, Mat};
use crate::solve::tangent::{Parameter, Uncertainty};

impl Plan {
    /// Returns the parameters by which the run is differentiated.
    ///
    /// Inertia, potential and momentum are linear in each number of a scenario by itself, plus a constant. So the rate of each
    /// is a difference between two values of the number, without an error but rounding.
    pub(crate) fn parameters<const N: usize>(&self) -> Vec<Parameter<N>> {
        let pointers = self.settled.derivatives.iter().flat_map(|asked| &asked.parameters);
        pointers.map(|pointer| self.parameter(pointer)).collect()
    }

    /// Returns what is uncertain of the start and of the parameters; `None` if no covariance is asked for.
    pub(crate) fn uncertainty(&self) -> Option<Uncertainty> {
        let asked = self.settled.derivatives.as_ref()?.covariance.as_ref()?;
        let d = so::dimension(self.dimension);
        let factor = match &asked.matrix {
            Some(matrix) => semidefinite("/derivatives/covariance/matrix", matrix)
                .expect("the scenario was checked"),
            None => {
                let deviation =
                    |k| if k < d { asked.attitude_spread_rad } else { asked.momentum_spread };
                let row = |i| (0..2 * d).map(|j| if i == j { deviation(i) } else { 0.0 }).collect();
                (0..2 * d).map(row).collect()
            }
        };
        let columns = (0..2 * d).map(|j| factor.iter().map(move |row: &Vec<f64>| row[j]));
        let columns = columns.filter(|column| column.clone().any(|x| x != 0.0));
        let start = columns.flatten().collect();
        Some(Uncertainty { start, parameters: asked.parameter_spreads.clone() })
    }

    fn parameter<const N: usize>(&self, pointer: &str) -> Parameter<N> {
        let document = serde_json::to_value(&self.settled).unwrap_or_default();
        let given = document.pointer(pointer).and_then(Value::as_f64).unwrap_or_default();
        let high = if given == 0.0 { 1.0 } else { 2.0 * given };
        let at = |value: f64| -> Scenario {
            let mut document = document.clone();
            set(&mut document, pointer, json!(value)).expect("the scenario has the field");
            from_tree(document).expect("the field is a number")
        };
        let (below, above) = (at(0.0), at(high));

        // J = tr(D) I - D in n dimensions: D = tr(J) I / (n - 1) - J
        let of = |scenario: &Scenario| -> DMatrix<f64> {
            let given = scenario.scene.inertia.as_ref();
            inertia_matrix(given.expect("derivatives are for one body"))
        };
        let [low, top] = [&below, &above].map(of);
        let rate = (&top - &low) / high;
        let trace = DMatrix::identity(N, N) * (rate.trace() / (N as f64 - 1.0));
        let second_moments = trace - rate;
        let second_moments = so::symmetric_part(&Mat::from_fn(|i, j| second_moments[(i, j)]));

        let inertia = of(&self.settled);
        let terms = |scenario: &Scenario, inertia: &DMatrix<f64>| -> Vec<Term<N>> {
            let given = scenario.scene.potential.iter();
            given.map(|given| term(&with_matrix(given, inertia))).collect()
        };
        let of_terms = terms(&self.settled, &inertia).into_iter();
        let of_terms = of_terms.zip(terms(&above, &top)).zip(terms(&below, &low));
        let changed = of_terms.filter(|((_, above), below)| above != below);
        let rates = changed
            .filter_map(|((term, above), below)| Some((term, above.quotient(&below, high)?)));
        let terms = rates.collect();

        // The start, and J Omega of a start that is given by its velocity.
        let model = &self.model;
        let start = |scenario| momentum(scenario, &model.kinetic, &model.attitude, None);
        let start = (start(&above) - start(&below)) / high;
        let mut start = Mat::from_fn(|i, j| start[(i, j)]);
        if self.settled.scene.initial.angular_velocity.is_some() {
            let (body, state) = model.problem::<N>();
            start += so::asym(&so::product(&second_moments, &body.velocity(&state.momentum)));
        }
        Parameter { body: BodyRate { second_moments, terms }, start }
    }
}
