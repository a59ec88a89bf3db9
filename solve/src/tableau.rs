//! Butcher tableaux: the Gauss family to round-off, Kutta's classics, Dormand and Prince's of eighth order, and any
//! other with b_i != 0.
//!
//! Invariant: a [`Tableau`] is consistent (sum b = 1) and knows its order, found from order conditions and not from its
//! name. Only an explicit one may have a zero weight, and then it has no symplectic conjugate.

use thiserror::Error;

mod gauss;
mod in_lanes;

pub(crate) use in_lanes::TableauInLanes;

/// Coefficients `a_ij`, `b_j` of a Runge-Kutta method, as the internal points and the end point of the
/// VPD discrete Lagrangian use them (paper, 8 internal and restrict).
#[derive(Clone, Debug, PartialEq)]
pub struct Tableau {
    a: Vec<Vec<f64>>,
    b: Vec<f64>,
    c: Vec<f64>,
    ascending: Vec<usize>,
    order: u32,
}

/// Reason why coefficients do not make a usable tableau.
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
/// Order up to which the conditions of every tree are checked for a pair that is not symplectic by itself.
const MAX_PAIR_ORDER: u32 = 6;
/// Order up to which the conditions are checked for one tableau by itself: 200 trees.
const MAX_CLASSICAL_ORDER: u32 = 8;
/// Tolerance of an order condition; coefficients are good to a few units of the last place.
const CONDITION_TOLERANCE: f64 = 1e-12;

impl Tableau {
    /// A tableau from its coefficients; the nodes are the row sums of `a`.
    ///
    /// # Errors
    /// Fails if the shape is wrong, a weight of an implicit tableau is zero, or the weights do not
    /// sum to one.
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
        let sum: f64 = b.iter().sum();
        if (sum - 1.0).abs() > CONDITION_TOLERANCE {
            return Err(TableauError::Inconsistent { sum });
        }
        let c: Vec<f64> = a.iter().map(|row| row.iter().sum()).collect();
        let mut ascending: Vec<usize> = (0..stages).collect();
        ascending.sort_by(|&i, &j| c[i].total_cmp(&c[j]));
        let mut tableau = Self { a, b, c, ascending, order: 0 };
        match tableau.check_conjugate() {
            Ok(()) => tableau.order = tableau.simplified_order().max(tableau.pair_order()),
            Err(error) if !tableau.is_explicit() => return Err(error),
            Err(_) => {}
        }
        Ok(tableau)
    }

    /// Makes sure that it has a symplectic conjugate: that no weight is zero.
    ///
    /// # Errors
    /// Fails if a weight is zero.
    pub fn check_conjugate(&self) -> Result<(), TableauError> {
        match self.b.iter().position(|weight| weight.abs() < MIN_WEIGHT) {
            Some(stage) => Err(TableauError::ZeroWeight { stage, weight: self.b[stage] }),
            None => Ok(()),
        }
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

    /// Dormand and Prince's twelve stages of eighth order: the formula that DOP853 goes on with (Hairer, Norsett, Wanner,
    /// Solving ODEs I, 1993, II.5 and II.10).
    pub fn rk8() -> Self {
        let row = |stage: usize| {
            let mut row = match stage {
                0 => Vec::new(),
                stage => RK8_ROWS[stage - 1].to_vec(),
            };
            row.resize(RK8_WEIGHTS.len(), 0.0);
            row
        };
        let a = (0..RK8_WEIGHTS.len()).map(row).collect();
        Self::new(a, RK8_WEIGHTS.to_vec()).expect("the weights sum to one")
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

    /// All `c_i`.
    pub fn nodes(&self) -> &[f64] {
        &self.c
    }

    /// The stages in the order of their nodes.
    pub fn ascending(&self) -> &[usize] {
        &self.ascending
    }

    /// Order of the symplectic pair `(a, b)` and `a^ = b_j (1 - a_ji / b_i)` that the discrete
    /// Lagrangian makes of the tableau. Exact where the conditions checked decide it: up to order 6 for
    /// any tableau, up to any order for one that is symplectic by itself. 0 where a zero weight leaves no conjugate.
    pub fn order(&self) -> u32 {
        self.order
    }

    /// Is it symplectic by itself, but for rounding: `b_i a_ij + b_j a_ji = b_i b_j`?
    pub fn is_symplectic(&self) -> bool {
        /// Rounding error of a coefficient.
        const ROUNDED: f64 = 1e-14;
        let part = |i: usize, j: usize| self.a[i][j] / self.b[j];
        let stages = self.stages();
        (0..stages).all(|i| (0..stages).all(|j| (part(i, j) + part(j, i) - 1.0).abs() < ROUNDED))
    }

    /// Does each stage need the earlier ones only?
    pub fn is_explicit(&self) -> bool {
        self.a.iter().enumerate().all(|(i, row)| row[i..].iter().all(|&a| a == 0.0))
    }

    /// Order of the tableau as a Runge-Kutta method by itself, without its conjugate: at least [`Self::order`].
    /// Exact up to order 8, and never more than that for a tableau that is not symplectic.
    pub fn classical_order(&self) -> u32 {
        self.order.max(self.tree_order(std::slice::from_ref(&self.a), MAX_CLASSICAL_ORDER))
    }

    /// The momentum's conjugate coefficients `a^_ij = b_j (1 - a_ji / b_i)`.
    fn conjugate(&self, i: usize, j: usize) -> f64 {
        self.b[j] * (1.0 - self.a[j][i] / self.b[i])
    }

    /// Lower bound of the order of a symplectic tableau, from Butcher's simplifying
    /// assumptions B(p), C(q), D(r): at least min(p, q + r + 1, 2 q + 2).
    fn simplified_order(&self) -> u32 {
        let s = self.stages();
        let holds = |left: f64, right: f64| (left - right).abs() <= CONDITION_TOLERANCE;
        let is_symplectic =
            (0..s).all(|i| (0..s).all(|j| holds(self.a[i][j], self.conjugate(i, j))));
        if !is_symplectic {
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
        let conjugate = (0..s).map(|i| (0..s).map(|j| self.conjugate(i, j)).collect()).collect();
        self.tree_order(&[self.a.clone(), conjugate], MAX_PAIR_ORDER)
    }

    /// The order from the conditions of all rooted trees with vertices of as many colours as there are
    /// `matrices`, up to `most`: `sum_i b_i Phi_i(t) = 1 / gamma(t)`
    /// (Hairer, Lubich, Wanner, Geometric Numerical Integration, III.1 and III.2).
    fn tree_order(&self, matrices: &[Vec<Vec<f64>>], most: u32) -> u32 {
        let s = self.stages();
        // A branch: a tree hung below an edge of one colour, its weight at each stage, 1 / gamma, size.
        let mut branches: Vec<Tree> = Vec::new();
        for order in 1..=most {
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
        most
    }
}

/// Rows 1 to 11 of `a` below the diagonal, of [`Tableau::rk8`].
const RK8_ROWS: [&[f64]; 11] = [
    &[0.05260015195876773],
    &[0.0197250569845379, 0.0591751709536137],
    &[0.02958758547680685, 0.0, 0.08876275643042054],
    &[0.2413651341592667, 0.0, -0.8845494793282861, 0.924834003261792],
    &[0.037037037037037035, 0.0, 0.0, 0.17082860872947386, 0.12546768756682242],
    &[0.037109375, 0.0, 0.0, 0.17025221101954405, 0.06021653898045596, -0.017578125],
    &[
        0.03709200011850479,
        0.0,
        0.0,
        0.17038392571223998,
        0.10726203044637328,
        -0.015319437748624402,
        0.008273789163814023,
    ],
    &[
        0.6241109587160757,
        0.0,
        0.0,
        -3.3608926294469414,
        -0.868219346841726,
        27.59209969944671,
        20.154067550477894,
        -43.48988418106996,
    ],
    &[
        0.47766253643826434,
        0.0,
        0.0,
        -2.4881146199716677,
        -0.590290826836843,
        21.230051448181193,
        15.279233632882423,
        -33.28821096898486,
        -0.020331201708508627,
    ],
    &[
        -0.9371424300859873,
        0.0,
        0.0,
        5.186372428844064,
        1.0914373489967295,
        -8.149787010746927,
        -18.52006565999696,
        22.739487099350505,
        2.4936055526796523,
        -3.0467644718982196,
    ],
    &[
        2.273310147516538,
        0.0,
        0.0,
        -10.53449546673725,
        -2.0008720582248625,
        -17.9589318631188,
        27.94888452941996,
        -2.8589982771350235,
        -8.87285693353063,
        12.360567175794303,
        0.6433927460157636,
    ],
];
/// Its weights.
const RK8_WEIGHTS: [f64; 12] = [
    0.054293734116568765,
    0.0,
    0.0,
    0.0,
    0.0,
    4.450312892752409,
    1.8915178993145003,
    -5.801203960010585,
    0.3111643669578199,
    -0.1521609496625161,
    0.20136540080403034,
    0.04471061572777259,
];

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
        // Euler: with its conjugate the symplectic Euler method, first order.
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
        let rk8 = Tableau::rk8();
        assert!(rk8.is_explicit());
        assert_eq!((rk8.order(), rk8.classical_order()), (0, 8));
        assert!(matches!(rk8.check_conjugate(), Err(TableauError::ZeroWeight { stage: 1, .. })));
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
                let entries = [t.a[i].as_slice(), &t.a[stages - 1 - i]].concat();
                let last_places = entries.iter().map(|a| a.abs()).sum::<f64>() * f64::EPSILON / 2.0;
                let both = exact(&entries);
                let defect = (both.high - 1.0) + both.low;
                assert!(defect.abs() <= last_places, "{stages} stages: {defect:e}");
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
