//! A tableau of any number of stages, as steps of several bodies take it.
//!
//! Invariant: `e_ij = a_ij / b_j` enters the attitudes and, transposed, the momenta with the same bits.

use crate::tableau::Tableau;

/// The coefficients of a tableau of any number of stages; matrices row by row.
#[derive(Clone, Debug)]
pub(super) struct Coefficients {
    pub(super) stages: usize,
    /// `e_kj = a_kj / b_j`
    pub(super) part: Vec<f64>,
    /// `e_jk`
    pub(super) transposed: Vec<f64>,
    /// `1 - e_jk`, the conjugate coefficients.
    pub(super) conjugate: Vec<f64>,
    /// `1 - e_jk - e_kj`; `None` for a symplectic tableau.
    pub(super) conjugate_defect: Option<Vec<f64>>,
    pub(super) weights: Vec<f64>,
    pub(super) nodes: Vec<f64>,
}

impl Coefficients {
    /// Those of a tableau whose weights are not zero.
    pub(super) fn new(tableau: &Tableau) -> Self {
        let stages = tableau.stages();
        let is_symplectic = tableau.is_symplectic();
        let quotient = |i: usize, j: usize| tableau.a(i, j) / tableau.b(j);
        // As in lanes: of two that sum to one, the smaller is one minus the larger.
        let e = |i: usize, j: usize| {
            let from_other = is_symplectic && quotient(i, j) < quotient(j, i);
            if from_other { 1.0 - quotient(j, i) } else { quotient(i, j) }
        };
        let all = |entry: &dyn Fn(usize, usize) -> f64| -> Vec<f64> {
            (0..stages * stages).map(|at| entry(at / stages, at % stages)).collect()
        };
        let conjugate = |k: usize, j: usize| if is_symplectic { e(k, j) } else { 1.0 - e(j, k) };
        Self {
            stages,
            part: all(&e),
            transposed: all(&|k, j| e(j, k)),
            conjugate: all(&conjugate),
            conjugate_defect: (!is_symplectic).then(|| all(&|k, j| conjugate(k, j) - e(k, j))),
            weights: (0..stages).map(|j| tableau.b(j)).collect(),
            nodes: tableau.nodes().to_vec(),
        }
    }
}

/// `out_k = sum_j coefficients_kj a_j`
#[inline(always)]
pub(super) fn combination(coefficients: &[f64], stages: usize, a: &[f64], out: &mut [f64]) {
    let len = out.len() / stages;
    for (k, out) in out.chunks_exact_mut(len).enumerate() {
        let row = &coefficients[k * stages..(k + 1) * stages];
        for (j, (a, &coefficient)) in a.chunks_exact(len).zip(row).enumerate() {
            if j == 0 {
                for (out, a) in out.iter_mut().zip(a) {
                    *out = coefficient * a;
                }
            } else {
                for (out, a) in out.iter_mut().zip(a) {
                    *out += coefficient * a;
                }
            }
        }
    }
}
