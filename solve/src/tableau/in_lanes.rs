//! A tableau in lanes: its coefficients as the stages of a step, side by side, take them.
//!
//! Invariant: `e_ij = a_ij / b_j` enters the attitudes and, transposed, the momenta with the same bits, so that the pair is
//! symplectic whatever their rounding; lanes beyond the stages are zero.

use super::Tableau;
use crate::lanes::{Row, WIDTH};

/// A tableau of up to [`WIDTH`] stages, in lanes.
#[derive(Clone, Debug)]
pub(crate) struct TableauInLanes {
    pub(crate) stages: usize,
    /// `e_ij`, column by column.
    pub(crate) columns: [Row; WIDTH],
    /// `e_ij`, row by row: the columns of its transpose.
    pub(crate) rows: [Row; WIDTH],
    /// `1 - e_ji`, column by column, the conjugate coefficients; the same as `columns` for a symplectic tableau.
    pub(crate) conjugate: [Row; WIDTH],
    /// `1 - e_ji - e_ij`, column by column; `None` for a symplectic tableau.
    pub(crate) conjugate_defect: Option<[Row; WIDTH]>,
    pub(crate) weights: Row,
    pub(crate) nodes: Row,
}

impl TableauInLanes {
    /// Returns a tableau in lanes; `None` if it has more stages than there are.
    pub(crate) fn new(tableau: &Tableau) -> Option<Self> {
        let stages = tableau.stages();
        if stages > WIDTH {
            return None;
        }
        let zero = Row::splat(0.0);
        let none = [zero; WIDTH];
        let (columns, rows, conjugate, conjugate_defect) = (none, none, none, None);
        let (weights, nodes) = (zero, zero);
        let mut lanes = Self { stages, columns, rows, conjugate, conjugate_defect, weights, nodes };
        let part = |i: usize, j: usize| tableau.a(i, j) / tableau.b(j);
        let is_symplectic = tableau.is_symplectic();
        for i in 0..stages {
            lanes.weights[i] = tableau.b(i);
            lanes.nodes[i] = tableau.c(i);
            for j in 0..stages {
                // Of two entries of a symplectic tableau, which sum to one, the smaller is one minus the larger, to the last
                // bit; e_ii is 1/2 to the bit for the built-in Gauss tableaux.
                let from_other = is_symplectic && part(i, j) < part(j, i);
                let e = if from_other { 1.0 - part(j, i) } else { part(i, j) };
                lanes.columns[j][i] = e;
                lanes.rows[i][j] = e;
            }
        }
        lanes.conjugate = lanes.columns;
        if !is_symplectic {
            let mut defect = none;
            for i in 0..stages {
                for j in 0..stages {
                    lanes.conjugate[j][i] = 1.0 - lanes.columns[i][j];
                    defect[j][i] = lanes.conjugate[j][i] - lanes.columns[j][i];
                }
            }
            lanes.conjugate_defect = Some(defect);
        }
        Some(lanes)
    }

    /// Estimates the size of the defects of a step that turns by `angle`, in rad: `angle^(s+1) / (s+1)!`.
    #[inline(always)]
    pub(crate) fn order_of_defect(&self, angle: f64) -> f64 {
        (1..=self.stages + 1).fold(1.0, |product, m| product * angle / m as f64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The condition `e_ij + e_ji = 1` holds to the last bit off the diagonal and on it.
    #[test]
    fn gauss_tableaux_are_symplectic_to_the_bit() {
        for stages in 1..=8 {
            let tableau = Tableau::gauss(stages).expect("1 to 8 stages");
            let lanes = TableauInLanes::new(&tableau).expect("enough lanes");
            for i in 0..stages {
                for j in 0..stages {
                    let (e, other) = (lanes.columns[j][i], lanes.columns[i][j]);
                    assert_eq!(e.min(other), 1.0 - e.max(other), "{stages} stages, {i}, {j}");
                    assert_eq!(lanes.rows[i][j], e);
                }
                assert_eq!(lanes.columns[i][i], 0.5, "{stages} stages, {i}");
            }
            assert!(lanes.conjugate_defect.is_none());
        }
    }
}
