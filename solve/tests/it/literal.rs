//! One step as the paper has it: (24, vih) of Shen, Tran and Leok (2022), by its own maps and in its own order, without the
//! rearrangement and without the product's solver. The reference that the product's step is compared with; slow.
//!
//! A tag such as (24a, vih1) is an equation of the paper: its number in print and its label in the source.

use nalgebra::{DMatrix, DVector};
use vpd_solve::hamiltonian::RigidBody;
use vpd_solve::so::{Mat, asym, symmetric_part};
use vpd_solve::state::State;
use vpd_solve::tableau::Tableau;

/// Rounds of the fixed-point iterations, and of Newton's within: more than any of the tests needs.
const ROUNDS: usize = 200;
const INNER_ROUNDS: usize = 100;
const POLAR_ROUNDS: usize = 30;

/// P(A), the polar factor of A, by (4, newtoniterate).
fn polar<const N: usize>(a: &Mat<N>) -> Mat<N> {
    (0..POLAR_ROUNDS).fold(*a, |u, _| (u + u.try_inverse().expect("regular").transpose()) * 0.5)
}

/// X of `M X + X M^T = C`: the dense system.
fn lyapunov<const N: usize>(m: &Mat<N>, c: &Mat<N>) -> Mat<N> {
    let identity = DMatrix::<f64>::identity(N, N);
    let m = DMatrix::from_column_slice(N, N, m.as_slice());
    let system = identity.kronecker(&m) + m.kronecker(&identity);
    let rhs = DVector::from_column_slice(c.as_slice());
    Mat::from_column_slice(system.lu().solve(&rhs).expect("regular").as_slice())
}

/// `dP*_A(S) = U Z` with `P Z + Z P = S`, where `A = U P`: the adjoint of (6, dP).
fn adjoint_of_polar<const N: usize>(a: &Mat<N>, u: &Mat<N>, s: &Mat<N>) -> Mat<N> {
    u * lyapunov(&symmetric_part(&(u.transpose() * a)), s)
}

/// A law at the stages, as a step asks for it: the number of the stage, and what its unknowns are there.
pub(crate) struct StageLaw<'a, const N: usize> {
    /// dH/dmu(U_i, mu_i)
    pub(crate) velocity: &'a dyn Fn(usize, &Mat<N>) -> Mat<N>,
    /// dH/dg(U_i)
    pub(crate) gradient: &'a dyn Fn(usize, &Mat<N>) -> Mat<N>,
    /// Rounds of the iteration, and of the one within.
    pub(crate) rounds: [usize; 2],
}

/// (g0, p0) -> (g1, p1), p the body momentum.
pub(crate) fn step<const N: usize>(
    body: &RigidBody<N>,
    tableau: &Tableau,
    h: f64,
    start: &State<N>,
) -> State<N> {
    let law = StageLaw {
        velocity: &|_, mu| body.velocity(mu),
        gradient: &|_, u| body.gradient(u),
        rounds: [ROUNDS, INNER_ROUNDS],
    };
    step_and_stages(&law, tableau, h, start).0
}

/// The same for any law, and the attitudes of the stages.
pub(crate) fn step_and_stages<const N: usize>(
    law: &StageLaw<'_, N>,
    tableau: &Tableau,
    h: f64,
    start: &State<N>,
) -> (State<N>, Vec<Mat<N>>) {
    let stages = 0..tableau.stages();
    let (g0, p0) = (start.attitude, start.momentum);
    let (a, b) = (|i, j| tableau.a(i, j), |i| tableau.b(i));
    let sum =
        |of: &dyn Fn(usize) -> Mat<N>| stages.clone().fold(Mat::zeros(), |sum, i| sum + of(i));
    let each = |of: &dyn Fn(usize) -> Mat<N>| stages.clone().map(of).collect::<Vec<Mat<N>>>();

    // The unknowns: mu_k, U_k, g1, Lambda.
    let (mut mu, mut u) = (vec![p0; stages.len()], vec![g0; stages.len()]);
    let (mut g1, mut lambda) = (g0, -p0 * 0.5);
    let [rounds, inner_rounds] = law.rounds;
    for _ in 0..rounds {
        // (24f, vih6)  Omega_i = dH/dmu(U_i, mu_i)
        let omega = each(&|i| (law.velocity)(i, &mu[i]));
        // (24c, vih3)  U_i = P(A_i),  A_i = g0 + h sum_j a_ij U_j Omega_j
        let inner = each(&|i| g0 + sum(&|j| u[j] * omega[j] * (h * a(i, j))));
        let next_u = each(&|i| polar(&inner[i]));
        // (24b, vih2)  g1 = P(g0 + h sum_i b_i U_i Omega_i)
        let next_g1 = polar(&(g0 + sum(&|i| u[i] * omega[i] * (h * b(i)))));

        // b_i (dH/dU(U_i, mu_i) - asym(U_i^T g1 Lambda Omega_i^T)): what the maps of (24a, vih1) and (24d, vih4) are
        // applied to, with its weight.
        let force = each(&|i| {
            let bracket = (law.gradient)(i, &u[i])
                - asym(&(u[i].transpose() * g1 * lambda * omega[i].transpose()));
            bracket * b(i)
        });
        // (17a, f1), (19a, fff1)  S_j - asym(h U_j^T sum_l a_lj dP*_{A_l}(S_l) Omega_j^T) = force_j, by its own iteration.
        // The maps are linear: one solution for the forces of all stages is the sum of those for each.
        let adjoint = |s: &[Mat<N>]| each(&|l| adjoint_of_polar(&inner[l], &next_u[l], &s[l]));
        let mut s = force.clone();
        for _ in 0..inner_rounds {
            let image = adjoint(&s);
            s = each(&|j| {
                let along = sum(&|l| image[l] * a(l, j));
                force[j] + asym(&(u[j].transpose() * along * omega[j].transpose())) * h
            });
        }
        let image = adjoint(&s);

        // (24a, vih1) with (17b, f2)
        // mu_k = -asym(U_k^T g1 Lambda) + (h / b_k) asym(U_k^T sum_l a_lk dP*_{A_l}(S_l))
        mu = each(&|k| {
            let along = sum(&|l| image[l] * a(l, k));
            asym(&(u[k].transpose() * along)) * (h / b(k)) - asym(&(u[k].transpose() * g1 * lambda))
        });
        // (24d, vih4) with (19b, fff2)
        // asym(g0^T g1 Lambda) = -p0 + h asym(g0^T sum_l dP*_{A_l}(S_l)), for the skew Lambda a Lyapunov equation:
        // asym(f Lambda) = f Lambda + Lambda f^T with f = g0^T g1
        let rhs = asym(&(g0.transpose() * sum(&|l| image[l]))) * h - p0;
        lambda = lyapunov(&(g0.transpose() * g1), &rhs);
        (u, g1) = (next_u, next_g1);
    }
    // (24e, vih5)  p1 = asym(g1^T (g0 + h sum_i b_i U_i Omega_i) Lambda^T)
    let end = g0 + sum(&|i| u[i] * (law.velocity)(i, &mu[i]) * (h * b(i)));
    let momentum = asym(&(g1.transpose() * end * lambda.transpose()));
    (State { attitude: g1, momentum }, u)
}
