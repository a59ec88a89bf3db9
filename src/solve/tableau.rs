//! Butcher tableaux: the Gauss family to round-off, Kutta's classics, and any other with b_i != 0.
//!
//! Invariant: a [`Tableau`] is consistent (sum b = 1), has no zero weight and knows its order, found
//! from order conditions and not from its name.

use thiserror::Error;

mod gauss;

/// Coefficients `a_ij`, `b_j` of a Runge-Kutta method, as the internal points and the end point of the
/// VPD discrete Lagrangian use them (paper, internal and restrict).
#[derive(Clone, Debug, PartialEq)]
pub struct Tableau {
    a: Vec<Vec<f64>>,
    b: Vec<f64>,
    c: Vec<f64>,
    ascending: Vec<usize>,
    order: u32,
}

/// Why coefficients do not make a usable tableau.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum TableauError {
    /// `a` is not square of the size of `b`, or empty, or larger than [`MAX_STAGES`].
    #[error(
        "a must be {stages} rows of {stages} numbers for {stages} weights (1 to {MAX_STAGES} stages)"
    )]
    Shape {
        /// Number of weights.
        stages: usize,
    },
    /// A coefficient is not finite or its size is beyond any use.
    #[error("every coefficient must be a finite number of size at most {MAX_COEFFICIENT}")]
    Size,
    /// A weight is zero: the stage momentum divides by it.
    #[error(
        "b[{stage}] = {weight:e}: every weight must be at least {MIN_WEIGHT:e} in size, the stage momentum divides by it"
    )]
    ZeroWeight {
        /// Index of the weight.
        stage: usize,
        /// The weight given.
        weight: f64,
    },
    /// The weights do not sum to one.
    #[error("the weights sum to {sum}, not to 1")]
    Inconsistent {
        /// Their sum.
        sum: f64,
    },
}

/// Largest number of stages accepted.
pub const MAX_STAGES: usize = 16;
/// Smallest weight accepted.
pub const MIN_WEIGHT: f64 = 1e-6;
/// Largest coefficient accepted.
pub const MAX_COEFFICIENT: f64 = 1e3;
/// Order up to which the conditions of every tree are checked for a tableau that is not symplectic.
const MAX_TREE_ORDER: u32 = 6;
/// Tolerance of an order condition; coefficients are good to a few units of the last place.
const CONDITION_TOLERANCE: f64 = 1e-12;

impl Tableau {
    /// A tableau from its coefficients; the nodes are the row sums of `a`.
    ///
    /// # Errors
    /// If the shape is wrong, a weight is zero, or the weights do not sum to one.
    pub fn new(a: Vec<Vec<f64>>, b: Vec<f64>) -> Result<Self, TableauError> {
        let stages = b.len();
        let square = a.len() == stages && a.iter().all(|row| row.len() == stages);
        if !square || stages == 0 || stages > MAX_STAGES {
            return Err(TableauError::Shape { stages });
        }
        let usable = |x: &f64| x.abs() <= MAX_COEFFICIENT;
        if !a.iter().flatten().chain(&b).all(usable) {
            return Err(TableauError::Size);
        }
        if let Some(stage) = b.iter().position(|weight| weight.abs() < MIN_WEIGHT) {
            let weight = b[stage];
            return Err(TableauError::ZeroWeight { stage, weight });
        }
        let sum: f64 = b.iter().sum();
        if (sum - 1.0).abs() > CONDITION_TOLERANCE {
            return Err(TableauError::Inconsistent { sum });
        }
        let c: Vec<f64> = a.iter().map(|row| row.iter().sum()).collect();
        let mut ascending: Vec<usize> = (0..stages).collect();
        ascending.sort_by(|&i, &j| c[i].total_cmp(&c[j]));
        let mut tableau = Self { a, b, c, ascending, order: 0 };
        tableau.order = tableau.simplified_order().max(tableau.pair_order());
        Ok(tableau)
    }

    /// Gauss collocation with `stages` nodes, order 2 `stages`.
    ///
    /// `None` for 0 or more than 8 stages.
    pub fn gauss(stages: usize) -> Option<Self> {
        if !(1..=8).contains(&stages) {
            return None;
        }
        let (a, b) = gauss::coefficients(stages);
        Self::new(a, b).ok()
    }

    /// Kutta's third-order method, of the paper's table 1.
    pub fn rk3() -> Self {
        let a = vec![vec![0.0; 3], vec![0.5, 0.0, 0.0], vec![-1.0, 2.0, 0.0]];
        let b = vec![1.0 / 6.0, 2.0 / 3.0, 1.0 / 6.0];
        Self::new(a, b).expect("Kutta's coefficients are consistent")
    }

    /// Kutta's classical fourth-order method.
    pub fn rk4() -> Self {
        let mut a = vec![vec![0.0; 4]; 4];
        (a[1][0], a[2][1], a[3][2]) = (0.5, 0.5, 1.0);
        let b = vec![1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0];
        Self::new(a, b).expect("Kutta's coefficients are consistent")
    }

    /// Number of stages s.
    pub fn stages(&self) -> usize {
        self.b.len()
    }

    /// `a_ij`.
    pub fn a(&self, i: usize, j: usize) -> f64 {
        self.a[i][j]
    }

    /// `b_j`.
    pub fn b(&self, j: usize) -> f64 {
        self.b[j]
    }

    /// `c_i`, the row sums of `a`.
    pub fn c(&self, i: usize) -> f64 {
        self.c[i]
    }

    /// The stages in the order of their nodes.
    pub fn ascending(&self) -> &[usize] {
        &self.ascending
    }

    /// Order of the symplectic pair `(a, b)` and `a^ = b_j (1 - a_ji / b_i)` that the discrete
    /// Lagrangian makes of the tableau. Exact where the conditions checked decide it: up to order 6 for
    /// any tableau, up to any order for one that is symplectic by itself.
    pub fn order(&self) -> u32 {
        self.order
    }

    /// Does each stage need the earlier ones only?
    pub fn is_explicit(&self) -> bool {
        self.a.iter().enumerate().all(|(i, row)| row[i..].iter().all(|&a| a == 0.0))
    }

    /// Order of the tableau as a Runge-Kutta method by itself, without a partner: at least [`Self::order`].
    /// Exact up to order 6, and never more than that for a tableau that is not symplectic.
    pub fn classical_order(&self) -> u32 {
        self.order.max(self.tree_order(std::slice::from_ref(&self.a)))
    }

    /// The momentum's partner coefficients `a^_ij = b_j (1 - a_ji / b_i)`.
    fn partner(&self, i: usize, j: usize) -> f64 {
        self.b[j] * (1.0 - self.a[j][i] / self.b[i])
    }

    /// Lower bound of the order of a tableau that is its own partner, from Butcher's simplifying
    /// assumptions B(p), C(q), D(r): at least min(p, q + r + 1, 2 q + 2).
    fn simplified_order(&self) -> u32 {
        let s = self.stages();
        let holds = |left: f64, right: f64| (left - right).abs() <= CONDITION_TOLERANCE;
        let own_partner = (0..s).all(|i| (0..s).all(|j| holds(self.a[i][j], self.partner(i, j))));
        if !own_partner {
            return 0;
        }
        let power = |i: usize, q: u32| self.c[i].powi(q as i32);
        let count = |condition: &dyn Fn(u32) -> bool| {
            (1..=2 * MAX_STAGES as u32).take_while(|&q| condition(q)).count() as u32
        };
        let quadrature = count(&|q| {
            let sum = (0..s).map(|i| self.b[i] * power(i, q - 1)).sum();
            holds(sum, 1.0 / f64::from(q))
        });
        let rows = count(&|q| {
            (0..s).all(|i| {
                let sum = (0..s).map(|j| self.a[i][j] * power(j, q - 1)).sum();
                holds(sum, power(i, q) / f64::from(q))
            })
        });
        let columns = count(&|q| {
            (0..s).all(|j| {
                let sum = (0..s).map(|i| self.b[i] * power(i, q - 1) * self.a[i][j]).sum();
                holds(sum, self.b[j] * (1.0 - power(j, q)) / f64::from(q))
            })
        });
        quadrature.min(rows + columns + 1).min(2 * rows + 2)
    }

    /// The order of the pair of position and momentum coefficients.
    fn pair_order(&self) -> u32 {
        let s = self.stages();
        let partner = (0..s).map(|i| (0..s).map(|j| self.partner(i, j)).collect()).collect();
        self.tree_order(&[self.a.clone(), partner])
    }

    /// The order from the conditions of all rooted trees with vertices of as many colours as there are
    /// `matrices`, up to [`MAX_TREE_ORDER`]: `sum_i b_i Phi_i(t) = 1 / gamma(t)`
    /// (Hairer, Lubich, Wanner, Geometric Numerical Integration, III.1 and III.2).
    fn tree_order(&self, matrices: &[Vec<Vec<f64>>]) -> u32 {
        let s = self.stages();
        // A branch: a tree hung below an edge of one colour, its weight at each stage, 1 / gamma, size.
        let mut branches: Vec<Tree> = Vec::new();
        for order in 1..=MAX_TREE_ORDER {
            let mut grown = Vec::new();
            graft(
                &branches,
                0,
                Tree { weight: vec![1.0; s], density: 1.0, size: 1 },
                order,
                &mut grown,
            );
            for tree in &mut grown {
                tree.density *= f64::from(order);
                let sum: f64 = (0..s).map(|i| self.b[i] * tree.weight[i]).sum();
                if (sum * tree.density - 1.0).abs() > 10.0 * CONDITION_TOLERANCE * tree.density {
                    return order - 1;
                }
            }
            for tree in grown {
                for matrix in matrices {
                    let below =
                        |row: &Vec<f64>| row.iter().zip(&tree.weight).map(|(a, w)| a * w).sum();
                    let weight = matrix.iter().map(below).collect();
                    branches.push(Tree { weight, density: tree.density, size: tree.size });
                }
            }
        }
        MAX_TREE_ORDER
    }
}

/// A rooted tree as the order conditions see it.
#[derive(Clone)]
struct Tree {
    weight: Vec<f64>,
    density: f64,
    size: u32,
}

/// All ways to hang branches (in non-decreasing index order) below `root` so that it has `size` vertices.
fn graft(branches: &[Tree], first: usize, root: Tree, size: u32, grown: &mut Vec<Tree>) {
    if root.size == size {
        grown.push(root);
        return;
    }
    for (index, branch) in branches.iter().enumerate().skip(first) {
        if root.size + branch.size > size {
            break;
        }
        let weight = root.weight.iter().zip(&branch.weight).map(|(r, b)| r * b).collect();
        let joined =
            Tree { weight, density: root.density * branch.density, size: root.size + branch.size };
        graft(branches, index, joined, size, grown);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_order_comes_from_the_conditions() {
        for stages in 1..=8 {
            let gauss = Tableau::gauss(stages).expect("1 to 8 stages");
            assert_eq!(gauss.order(), 2 * stages as u32);
        }
        assert_eq!((Tableau::rk3().order(), Tableau::rk4().order()), (3, 4));
        // Euler: with its partner the symplectic Euler method, first order.
        assert_eq!(Tableau::new(vec![vec![0.0]], vec![1.0]).expect("consistent").order(), 1);
        // Heun's second-order method.
        let heun = Tableau::new(vec![vec![0.0, 0.0], vec![1.0, 0.0]], vec![0.5, 0.5]);
        assert_eq!(heun.expect("consistent").order(), 2);
    }

    #[test]
    fn explicit_tableaux_know_themselves() {
        for (tableau, order) in [(Tableau::rk3(), 3), (Tableau::rk4(), 4)] {
            assert!(tableau.is_explicit());
            assert_eq!(tableau.classical_order(), order);
        }
        let gauss = Tableau::gauss(4).expect("4 stages");
        assert!(!gauss.is_explicit());
        assert_eq!(gauss.classical_order(), 8);
        // Ralston's third-order method; its pair is of order 2.
        let a = vec![vec![0.0; 3], vec![0.5, 0.0, 0.0], vec![0.0, 0.75, 0.0]];
        let ralston = Tableau::new(a, vec![2.0 / 9.0, 1.0 / 3.0, 4.0 / 9.0]).expect("consistent");
        assert_eq!(ralston.classical_order(), 3);
    }

    #[test]
    fn gauss_is_symplectic_to_round_off() {
        for stages in 1..=8 {
            let t = Tableau::gauss(stages).expect("1 to 8 stages");
            for i in 0..stages {
                for j in 0..stages {
                    let defect = t.b[i] * t.a[i][j] + t.b[j] * t.a[j][i] - t.b[i] * t.b[j];
                    assert!(defect.abs() < 1e-16, "{stages} stages: {defect:e}");
                }
            }
        }
    }

    #[test]
    fn gauss_keeps_its_clock() {
        let exact = |numbers: &[f64]| gauss::total(numbers.iter().map(|&x| gauss::Twice::from(x)));
        for stages in 1..=8 {
            let t = Tableau::gauss(stages).expect("1 to 8 stages");
            // Not by one digit too much or too little: the sum of doubles is the number one.
            let sum = exact(&t.b);
            assert_eq!((sum.high, sum.low), (1.0, 0.0), "{stages} stages");
            for i in 0..stages {
                assert_eq!(t.b[i], t.b[stages - 1 - i]);
                // A row sums to its node, of which there are two that make one, up to half a unit of each entry.
                let last_place = t.a[i].iter().map(|a| a.abs()).sum::<f64>() * f64::EPSILON / 2.0;
                let both = exact(&[t.a[i].as_slice(), &t.a[stages - 1 - i]].concat());
                let defect = (both.high - 1.0) + both.low;
                assert!(defect.abs() <= 2.0 * last_place, "{stages} stages: {defect:e}");
            }
        }
    }

    #[test]
    fn known_coefficients() {
        let root = 3.0_f64.sqrt() / 6.0;
        let gauss = Tableau::gauss(2).expect("2 stages");
        let expected = [[0.25, 0.25 - root], [0.25 + root, 0.25]];
        for i in 0..2 {
            for j in 0..2 {
                assert!((gauss.a[i][j] - expected[i][j]).abs() < 1e-16);
            }
        }
    }

    #[test]
    fn unusable_coefficients_are_refused() {
        let one = |b: Vec<f64>| Tableau::new(vec![vec![0.5; b.len()]; b.len()], b);
        assert!(matches!(one(vec![]), Err(TableauError::Shape { .. })));
        assert!(matches!(one(vec![1.0, 0.0]), Err(TableauError::ZeroWeight { stage: 1, .. })));
        assert!(matches!(one(vec![0.4, 0.4]), Err(TableauError::Inconsistent { .. })));
        assert!(matches!(one(vec![f64::NAN]), Err(TableauError::Size)));
        assert!(matches!(
            Tableau::new(vec![vec![0.0]], vec![0.5, 0.5]),
            Err(TableauError::Shape { stages: 2 })
        ));
    }
}
