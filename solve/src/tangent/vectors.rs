//! The derivative of a step of VPD for n = 3: the linear system of [`super`] in vectors, by blocks.
//!
//! Stages are given by their attitudes and momenta; X, Lambda and f follow from these by linear systems. In the vectors of
//! so(3), `L(A, B)` is the 3 x 3 matrix that takes e to `vee asym(A hat(e) B)`:
//!
//! ```text
//! L(A, I) = tr(A) I - A^T        L(A, hat(b)) = -hat(A b) - (vee asym A) b^T        L(I, B) = tr(B) I - B
//! L(A, B)_rc = A_r1c1 D_r2c2 + D_r1c1 A_r2c2 - A_r1c2 D_r2c1 - D_r1c2 A_r2c1,  D = B^T, (r, r1, r2), (c, c1, c2) cyclic
//! ```
//!
//! [d-X] is the transpose of [d-polar], as its unknown is the multiplier of that equation. So both have the factors of one matrix:
//! with `A eta = B dmu` for the first and H and O for the second derivatives by eta and by eta and dmu,
//!
//! ```text
//! eta = Z dmu,  Z = A^-1 B                A^T dX = -(H eta + O dmu + ..)
//! (h b J^-1 - O^T Z - Z^T O - Z^T H Z) dmu = ..                                       by phi, dLambda and xi
//! ```
//!
//! which leaves a symmetric system of 3 s unknowns and one of six. Rows and columns are (component, stage), the stages of a
//! component side by side, as the lanes compute them.

use fearless_simd::{Level, f64x2, f64x4, f64x8, prelude::*};

use crate::hamiltonian::RigidBody;
use crate::lanes::{Real, Row, Rows, StageScalar, WIDTH, widest};
use crate::so::{self, Mat};
use crate::so3;
use crate::space::{
    Mat3, Sym3, Vec3, dot, inverse_less_half, mat3, plus, product, scaled, symmetric_product,
    times_hat, transposed_matrix_product, transposed_product, vec3, vee_asym, with_one,
};
use crate::state::State;
use crate::tableau::Tableau;

/// Rows and columns of the largest system of the stages.
const ROWS: usize = 3 * WIDTH;
/// Columns of a right side.
const SIDES: usize = 12;
/// The residual of stages that are solved, relative to their sizes.
const SOLVED: f64 = 1e-12;
/// Smallest pivot next to the diagonal entry that it was: smaller ones lose digits.
const SMALLEST_PIVOT: f64 = 0.03;

/// A matrix by rows of `L` numbers at most.
#[derive(Clone, Debug)]
#[repr(C, align(64))]
struct Matrix<const L: usize>([[f64; L]; ROWS]);

impl<const L: usize> Matrix<L> {
    fn zeros() -> Box<Self> {
        Box::new(Self([[0.0; L]; ROWS]))
    }
}

/// The derivatives of steps of one body, the last of them, and room for what leads to it.
#[derive(Clone, Debug)]
pub(super) struct Vectors {
    body: RigidBody<3>,
    level: Option<Level>,
    stages: usize,
    /// `a_kj`, column by column and row by row, and `b_k`.
    columns: [Row; WIDTH],
    rows: [Row; WIDTH],
    weights: Row,
    /// J^-1.
    mobility: Mat3<f64>,
    given: Given,
    space: Space,
}

/// What a step is differentiated from: its stages, that have to be solved. Rows have a number for each stage.
#[derive(Clone, Debug)]
struct Given {
    /// `h a_kj`, column by column and row by row.
    columns: [Row; WIDTH],
    rows: [Row; WIDTH],
    /// `h b_k`.
    weights: Row,
    /// U_k by its entries.
    attitude: Mat3<Row>,
    momentum: Vec3<Row>,
    velocity: Vec3<Row>,
    start: State<3>,
}

/// The derivative, and room for what leads to it.
#[derive(Clone, Debug)]
struct Space {
    /// A, then its upper factor; the same of the system of dmu.
    a: Box<Matrix<ROWS>>,
    system: Box<Matrix<ROWS>>,
    /// The lower factor, and 1 / pivots.
    lower: Box<Matrix<ROWS>>,
    inverses: [f64; ROWS],
    /// B, then Z.
    z: Box<Matrix<ROWS>>,
    /// H.
    h: Box<Matrix<ROWS>>,
    /// O, then O + H Z / 2.
    o: Box<Matrix<ROWS>>,
    /// dmu by phi, dLambda and xi.
    momenta: Box<Matrix<SIDES>>,
    /// phi, dLambda and xi by the start.
    end: [[f64; 8]; 9],
    transition: [f64; 36],
    f: Mat<3>,
    p1: Vec3<f64>,
}

impl Vectors {
    /// For steps of `tableau`; `None` if it has more stages than there are lanes.
    pub(super) fn new(body: &RigidBody<3>, tableau: &Tableau) -> Option<Self> {
        let stages = tableau.stages();
        if stages > WIDTH {
            return None;
        }
        let (zero, one) = (Row::splat(0.0), Row::splat(1.0));
        let (mut columns, mut rows, mut weights) = ([zero; WIDTH], [zero; WIDTH], zero);
        for k in 0..stages {
            weights[k] = tableau.b(k);
            for j in 0..stages {
                columns[j][k] = tableau.a(k, j);
                rows[k][j] = tableau.a(k, j);
            }
        }
        let given = Given {
            columns,
            rows,
            weights,
            attitude: [[one, zero, zero], [zero, one, zero], [zero, zero, one]],
            momentum: [zero; 3],
            velocity: [zero; 3],
            start: State { attitude: Mat::identity(), momentum: Mat::zeros() },
        };
        let room = Matrix::zeros;
        let space = Space {
            a: room(),
            system: room(),
            lower: room(),
            inverses: [0.0; ROWS],
            z: room(),
            h: room(),
            o: room(),
            momenta: Matrix::zeros(),
            end: [[0.0; 8]; 9],
            transition: [0.0; 36],
            f: Mat::identity(),
            p1: [0.0; 3],
        };
        let inverse = body.inverse_inertia();
        let mobility = mat3!(i, j => inverse[(i, j)]);
        let (body, level) = (body.clone(), Some(Level::new()));
        Some(Self { body, level, stages, columns, rows, weights, mobility, given, space })
    }

    /// On another instruction set, or without lanes.
    pub(super) fn set_level(&mut self, level: Option<Level>) {
        self.level = level;
    }

    /// Differentiates the step of `h` seconds from `start` with these stages, each with its velocity. `false` if they are not
    /// solved, or if its equations need pivots.
    pub(super) fn differentiate(
        &mut self,
        h: f64,
        start: State<3>,
        stages: impl Iterator<Item = (State<3>, Mat<3>)>,
    ) -> bool {
        self.given.start = start;
        let Given { attitude, momentum, velocity, .. } = &mut self.given;
        let mut count = 0;
        for (k, (stage, omega)) in stages.take(self.stages).enumerate() {
            let (mu, omega) = (so3::vee(&stage.momentum), so3::vee(&omega));
            for i in 0..3 {
                momentum[i][k] = mu[i];
                velocity[i][k] = omega[i];
                for j in 0..3 {
                    attitude[i][j][k] = stage.attitude[(i, j)];
                }
            }
            count += 1;
        }
        count == self.stages && self.differentiate_given(h)
    }

    /// Differentiates the step of the stages that are given. Whoever hands them over is compiled for each n; this is not.
    fn differentiate_given(&mut self, h: f64) -> bool {
        let Given { columns, rows, weights, .. } = &mut self.given;
        for j in 0..WIDTH {
            weights[j] = h * self.weights[j];
            for k in 0..WIDTH {
                columns[j][k] = h * self.columns[j][k];
                rows[j][k] = h * self.rows[j][k];
            }
        }
        let in_lanes = match (self.level, self.stages) {
            (Some(level), 2) => widest!(
                level below Avx512, f64x2, lanes => Some(self.differentiated::<_, 8>(lanes)), else None
            ),
            (Some(level), 3 | 4) => widest!(
                level below Avx512, f64x4, lanes => Some(self.differentiated::<_, 16>(lanes)), else None
            ),
            (Some(level), 5..) => widest!(
                level below Avx512, f64x8, lanes => Some(self.differentiated::<_, 24>(lanes)), else None
            ),
            _ => None,
        };
        match (in_lanes, self.stages) {
            (Some(done), _) => done,
            (None, 1) => self.differentiated::<_, 8>(Rows([0.0; 1])),
            (None, 2) => self.differentiated::<_, 8>(Rows([0.0; 2])),
            (None, 3 | 4) => self.differentiated::<_, 16>(Rows([0.0; 4])),
            (None, _) => self.differentiated::<_, 24>(Rows([0.0; 8])),
        }
    }

    /// The derivative by the start, 6 x 6, row by row.
    pub(super) fn transition(&self) -> &[f64; 36] {
        &self.space.transition
    }

    /// f and p1.
    pub(super) fn end(&self) -> (Mat<3>, Mat<3>) {
        (self.space.f, so::hat(&self.space.p1))
    }

    /// How the stages change with the start: for each the rows of eta + U^T xi, then those of dmu, of six numbers.
    pub(super) fn changes(&self) -> Vec<f64> {
        let lanes = self.stages.next_power_of_two();
        let Space { z, momenta, end, .. } = &self.space;
        let mut dmu = [[0.0; 8]; ROWS];
        for (dmu, by) in dmu.iter_mut().zip(&momenta.0) {
            for (x, end) in by.iter().zip(end) {
                subtract::<8, 8>(dmu, end, -x);
            }
        }
        let mut changes = Vec::with_capacity(36 * self.stages);
        for k in 0..self.stages {
            for r in 0..3 {
                let mut eta = [0.0; 8];
                for (x, dmu) in z.0[r * lanes + k][..3 * lanes].iter().zip(&dmu) {
                    subtract::<8, 8>(&mut eta, dmu, -x);
                }
                for i in 0..3 {
                    eta[i] += self.given.attitude[i][r][k];
                }
                changes.extend_from_slice(&eta[..6]);
            }
            for r in 0..3 {
                changes.extend_from_slice(&dmu[r * lanes + k][..6]);
            }
        }
        changes
    }
}

/// `L(A, hat(b))`
#[inline(always)]
fn with_hat<T: Real>(a: &Mat3<T>, b: &Vec3<T>) -> Mat3<T> {
    let [x, y, z] = product(a, b);
    let r = vee_asym(a);
    [
        [-(r[0] * b[0]), z - r[0] * b[1], -y - r[0] * b[2]],
        [-z - r[1] * b[0], -(r[1] * b[1]), x - r[1] * b[2]],
        [y - r[2] * b[0], -x - r[2] * b[1], -(r[2] * b[2])],
    ]
}

/// `L(A, I)`
#[inline(always)]
fn alone<T: Real>(a: &Mat3<T>) -> Mat3<T> {
    let t = a[0][0] + a[1][1] + a[2][2];
    let mut l: Mat3<T> = mat3!(i, j => -a[j][i]);
    for i in 0..3 {
        l[i][i] = l[i][i] + t;
    }
    l
}

/// `L(A, D^T)`
#[inline(always)]
fn with<T: Real>(a: &Mat3<T>, d: &Mat3<T>) -> Mat3<T> {
    mat3!(r, c => {
        let (r1, r2, c1, c2) = ((r + 1) % 3, (r + 2) % 3, (c + 1) % 3, (c + 2) % 3);
        (a[r1][c1] * d[r2][c2] + d[r1][c1] * a[r2][c2])
            - (a[r1][c2] * d[r2][c1] + d[r1][c2] * a[r2][c1])
    })
}

/// `A B`
#[inline(always)]
fn times<T: Real>(a: &Mat3<T>, b: &Mat3<T>) -> Mat3<T> {
    mat3!(i, j => a[i][0] * b[0][j] + a[i][1] * b[1][j] + a[i][2] * b[2][j])
}

#[inline(always)]
fn factor<T: Real>(a: &Mat3<T>, x: T) -> Mat3<T> {
    mat3!(i, j => a[i][j] * x)
}

/// `hat(v)`
#[inline(always)]
fn hat<T: Real>(v: &Vec3<T>) -> Mat3<T> {
    let zero = v[0].constant(0.0);
    [[zero, -v[2], v[1]], [v[2], zero, -v[0]], [-v[1], v[0], zero]]
}

/// Stores the block of row k: its entries (r, c) for all j.
#[inline(always)]
fn put_row<R: StageScalar, const L: usize>(block: &Mat3<R>, k: usize, rows: &mut [[f64; L]; ROWS]) {
    let lanes = R::STAGES;
    for r in 0..3 {
        for c in 0..3 {
            block[r][c].put(&mut rows[r * lanes + k][c * lanes..]);
        }
    }
}

/// Stores blocks side by side in three rows from `first` on.
#[inline(always)]
fn put_rows<R: StageScalar>(blocks: &Mat3<R>, first: usize, rows: &mut [[f64; ROWS]]) {
    for r in 0..3 {
        for c in 0..3 {
            blocks[r][c].put(&mut rows[first + r][c * R::STAGES..]);
        }
    }
}

/// Adds blocks on the diagonal.
#[inline(always)]
fn add_diagonal<R: StageScalar<StepScalar = f64>>(
    blocks: &Mat3<R>,
    rows: &mut [[f64; ROWS]; ROWS],
) {
    let lanes = R::STAGES;
    for r in 0..3 {
        for c in 0..3 {
            let mut numbers = [0.0; WIDTH];
            blocks[r][c].put(&mut numbers);
            for k in 0..lanes {
                rows[r * lanes + k][c * lanes + k] += numbers[k];
            }
        }
    }
}

/// `sum - x row`, the first `L` numbers.
#[inline(always)]
fn subtract<const L: usize, const M: usize>(sum: &mut [f64; M], row: &[f64; M], x: f64) {
    for i in 0..L {
        sum[i] -= x * row[i];
    }
}

/// `sum - x row` from the column `j` on, by groups of eight; those before are free to change.
#[inline(always)]
fn subtract_from<const L: usize, const M: usize>(
    j: usize,
    sum: &mut [f64; M],
    row: &[f64; M],
    x: f64,
) {
    let groups = j / 8..L / 8;
    let sum = &mut sum.as_chunks_mut::<8>().0[groups.clone()];
    for (sum, row) in sum.iter_mut().zip(&row.as_chunks::<8>().0[groups]) {
        for c in 0..8 {
            sum[c] -= x * row[c];
        }
    }
}

/// `K^-1 sides` by elimination without pivots, the first `m` rows, `L` columns and sides counting; K becomes its upper factor. Is
/// every pivot large next to what it was before?
#[inline(always)]
fn divide<const L: usize, const S: usize, const T: usize>(
    m: usize,
    k: &mut [[f64; ROWS]; ROWS],
    lower: &mut [[f64; ROWS]; ROWS],
    inverses: &mut [f64; ROWS],
    sides: &mut [[f64; S]; ROWS],
) -> bool {
    let mut sizes = [0.0; ROWS];
    for i in 0..m {
        sizes[i] = SMALLEST_PIVOT * k[i][i].abs();
    }
    // Three rows at a time: the rows below are read and written once for the three.
    for j in (0..m).step_by(3) {
        for i in j..j + 3 {
            let pivot = k[i][i];
            if !(pivot.abs() > sizes[i]) {
                return false;
            }
            inverses[i] = 1.0 / pivot;
            let (above, below) = k.split_at_mut(i + 1);
            let (sides_above, sides_below) = sides.split_at_mut(i + 1);
            for other in i + 1..j + 3 {
                let row = &mut below[other - i - 1];
                let x = row[i] * inverses[i];
                lower[other][i] = x;
                subtract_from::<L, ROWS>(j, row, &above[i], x);
                row[i] = 0.0;
                subtract::<T, S>(&mut sides_below[other - i - 1], &sides_above[i], x);
            }
        }
        let (above, below) = k.split_at_mut(j + 3);
        let (sides_above, sides_below) = sides.split_at_mut(j + 3);
        let (Some(rows), Some(side_rows)) =
            (above[j..].first_chunk::<3>(), sides_above[j..].first_chunk::<3>())
        else {
            return false;
        };
        let lower = &mut lower[j + 3..m];
        for ((other, side), lower) in below.iter_mut().zip(sides_below).zip(lower) {
            let x = other[j] * inverses[j];
            let y = (other[j + 1] - x * rows[0][j + 1]) * inverses[j + 1];
            let z = ((other[j + 2] - x * rows[0][j + 2]) - y * rows[1][j + 2]) * inverses[j + 2];
            lower[j..j + 3].copy_from_slice(&[x, y, z]);
            let groups = j / 8..L / 8;
            let [first, second, third] = vec3!(i => &rows[i].as_chunks::<8>().0[groups.clone()]);
            let sums = &mut other.as_chunks_mut::<8>().0[groups];
            for (((sum, first), second), third) in sums.iter_mut().zip(first).zip(second).zip(third)
            {
                for c in 0..8 {
                    sum[c] = ((sum[c] - x * first[c]) - y * second[c]) - z * third[c];
                }
            }
            other[j..j + 3].fill(0.0);
            for c in 0..T {
                side[c] =
                    ((side[c] - x * side_rows[0][c]) - y * side_rows[1][c]) - z * side_rows[2][c];
            }
        }
    }
    for i in (0..m).rev() {
        let (above, below) = sides.split_at_mut(i + 1);
        let mut sum = [0.0; T];
        sum.copy_from_slice(&above[i][..T]);
        for (x, row) in k[i][i + 1..m].iter().zip(below) {
            for c in 0..T {
                sum[c] -= x * row[c];
            }
        }
        for c in 0..T {
            above[i][c] = sum[c] * inverses[i];
        }
    }
    true
}

/// `A^-T v`
#[inline(always)]
fn divide_transposed<const L: usize>(m: usize, space: &Space, v: &mut [f64; ROWS]) {
    let Space { a, lower, inverses, .. } = space;
    for i in 0..m {
        let x = v[i] * inverses[i];
        // The row is zero before the diagonal.
        subtract::<L, ROWS>(v, &a.0[i], x);
        v[i] = x;
    }
    for i in (0..m).rev() {
        let (x, row) = (v[i], &lower.0[i]);
        for c in 0..i {
            v[c] -= x * row[c];
        }
    }
}

/// `v^T Z`
#[inline(always)]
fn along<const L: usize>(m: usize, v: &[f64; ROWS], z: &Matrix<ROWS>) -> [f64; ROWS] {
    let mut sum = [0.0; L];
    for i in 0..m {
        for c in 0..L {
            sum[c] += v[i] * z.0[i][c];
        }
    }
    let mut all = [0.0; ROWS];
    all[..L].copy_from_slice(&sum);
    all
}

/// `K^-1 sides` by elimination with row pivots. Is K regular to working precision?
#[inline(always)]
fn solve(k: &mut [[f64; 8]; 6], sides: &mut [[f64; 8]; 6]) -> bool {
    let mut largest = 0.0_f64;
    for j in 0..6 {
        let mut pivot = j;
        for i in j + 1..6 {
            pivot = if k[i][j].abs() > k[pivot][j].abs() { i } else { pivot };
        }
        let size = k[pivot][j].abs();
        largest = if size > largest { size } else { largest };
        if !(size > f64::EPSILON * largest) {
            return false;
        }
        k.swap(pivot, j);
        sides.swap(pivot, j);
        let inverse = 1.0 / k[j][j];
        let (row, side) = (k[j], sides[j]);
        // Above the diagonal, too: what remains is diagonal.
        for i in 0..6 {
            let x = if i == j { 0.0 } else { k[i][j] * inverse };
            subtract::<8, 8>(&mut k[i], &row, x);
            subtract::<8, 8>(&mut sides[i], &side, x);
        }
    }
    for i in 0..6 {
        let inverse = 1.0 / k[i][i];
        for c in 0..8 {
            sides[i][c] *= inverse;
        }
    }
    largest.is_finite()
}

/// The system of dmu: `O^T Z + Z^T O + Z^T H Z`, subtracted from what is there.
#[inline(always)]
fn reduce<const L: usize>(m: usize, space: &mut Space) {
    let Space { z, h, o, system, .. } = space;
    for i in 0..m {
        let mut sum = [0.0; L];
        for k in 0..m {
            let x = h.0[i][k];
            for c in 0..L {
                sum[c] += x * z.0[k][c];
            }
        }
        for c in 0..L {
            o.0[i][c] += 0.5 * sum[c];
        }
    }
    for i in 0..m {
        let mut sum = [0.0; L];
        for k in 0..m {
            let x = z.0[k][i];
            for c in 0..L {
                sum[c] += x * o.0[k][c];
            }
        }
        system.0[i][..L].copy_from_slice(&sum);
    }
    for i in 0..m {
        for j in 0..i {
            let sum = system.0[i][j] + system.0[j][i];
            system.0[i][j] = -sum;
            system.0[j][i] = -sum;
        }
        system.0[i][i] *= -2.0;
    }
}

impl Vectors {
    #[inline(always)]
    fn differentiated<R, const L: usize>(&mut self, lanes: R) -> bool
    where
        R: StageScalar<StepScalar = f64, Storage = Row>,
    {
        let Self { body, stages, mobility: inverse, given, space, .. } = self;
        let (k_lanes, m) = (R::STAGES, 3 * R::STAGES);
        let Given { columns, rows, weights, start, .. } = &*given;
        let p0 = so3::vee(&start.momentum);
        let weight = lanes.row(weights);
        let u: Mat3<R> = mat3!(i, j => lanes.load(&given.attitude[i][j]));
        let mu: Vec3<R> = vec3!(i => lanes.load(&given.momentum[i]));
        let omega: Vec3<R> = vec3!(i => lanes.load(&given.velocity[i]));
        let mobility: Mat3<R> = mat3!(i, j => lanes.constant(inverse[i][j]));
        // A_k = U_k P_k, and the end.
        let w = times_hat(&u, &omega);
        let a: Mat3<R> = with_one(&mat3!(i, j => w[i][j].apply_tableau(columns)));
        let p = transposed_matrix_product(&u, &a);
        let off = vee_asym(&p);
        let off = off[0].abs().max_or_nan(off[1].abs()).max_or_nan(off[2].abs()).largest();
        let a_end: Mat3<f64> = with_one(&mat3!(i, j => (w[i][j] * weight).sum()));
        let Some(f) = so::polar(&Mat::<3>::from_fn(|i, j| a_end[i][j])) else { return false };
        space.f = f;
        let f: Mat3<f64> = mat3!(i, j => f[(i, j)]);
        let p_end = transposed_matrix_product(&f, &a_end);
        let q_end = alone(&p_end);
        // Forces, p1 and Lambda.
        let (force, hessian) = body.torque_and_rate(&start.attitude, &u);
        let impulses = scaled(&product(&u, &force), weight);
        let pi1: Vec3<f64> = vec3!(i => p0[i] - impulses[i].sum());
        let p1 = transposed_product(&f, &pi1);
        space.p1 = p1;
        let [xx, yy, zz] = vec3!(i => q_end[i][i] + -2.0);
        let less: Sym3<f64> =
            inverse_less_half(&[xx, yy, zz, q_end[1][2], q_end[0][2], q_end[0][1]]);
        let lambda: Vec3<f64> = {
            let v = symmetric_product(&less, &p1);
            vec3!(i => -(p1[i] * 0.5 + v[i]))
        };
        let f_lanes: Mat3<R> = mat3!(i, j => lanes.spread(f[i][j]));
        let lambda_lanes: Vec3<R> = vec3!(i => lanes.spread(lambda[i]));
        // F_k = f^T U_k
        let to_end = transposed_matrix_product(&f_lanes, &u);
        let back: Mat3<R> = mat3!(i, j => to_end[j][i]);

        // [d-polar]
        for k in 0..*stages {
            let uk: Mat3<R> = mat3!(i, j => lanes.spread(given.attitude[i][j][k]));
            let r = transposed_matrix_product(&uk, &u);
            let ak = lanes.row(&rows[k]);
            put_row(&factor(&with_hat(&r, &omega), -ak), k, &mut space.a.0);
            put_row(&factor(&times(&alone(&r), &mobility), ak), k, &mut space.z.0);
        }
        for k in *stages..k_lanes {
            let none: Mat3<R> = [[lanes.constant(0.0); 3]; 3];
            put_row(&none, k, &mut space.a.0);
            put_row(&none, k, &mut space.z.0);
            put_row(&none, k, &mut space.o.0);
            put_row(&none, k, &mut space.h.0);
        }
        add_diagonal(&alone(&p), &mut space.a.0);
        let Space { a, lower, inverses, z, .. } = &mut *space;
        if !divide::<L, ROWS, L>(m, &mut a.0, &mut lower.0, inverses, &mut z.0) {
            return false;
        }
        // X_k
        let mut x = [0.0; ROWS];
        let load = {
            let turned = product(&with_hat(&back, &omega), &lambda_lanes);
            scaled(&plus(&turned, &force), -weight)
        };
        for i in 0..3 {
            load[i].put(&mut x[i * k_lanes..]);
        }
        divide_transposed::<L>(m, space, &mut x);
        let x: Vec3<R> = vec3!(i => lanes.get(&x[i * k_lanes..]));
        // Q_k = U_k^T V_k
        let t = times_hat(&u, &x);
        let f_lambda = times_hat(&f_lanes, &lambda_lanes);
        let v: Mat3<R> = mat3!(i, j => weight * f_lambda[i][j] + t[i][j].apply_tableau(rows));
        let q = transposed_matrix_product(&u, &v);
        // Are the stages solved?
        let found = vee_asym(&q);
        let error: Vec3<R> = vec3!(i => (found[i] + weight * mu[i]).abs());
        let error = error[0].max_or_nan(error[1]).max_or_nan(error[2]).largest();
        let size: Vec3<R> = vec3!(i => (weight * mu[i]).abs());
        let size = size[0].max_or_nan(size[1]).max_or_nan(size[2]).largest();
        if !(off <= SOLVED && error <= SOLVED * size) {
            return false;
        }
        // [d-X]
        for k in 0..*stages {
            let uk: Mat3<R> = mat3!(i, j => lanes.spread(given.attitude[i][j][k]));
            let r = transposed_matrix_product(&uk, &u);
            let (ak, a_to) = (lanes.row(&rows[k]), lanes.row(&columns[k]));
            let (xk, wk): (Vec3<R>, Vec3<R>) = (
                vec3!(i => lanes.spread(x[i].stage(k))),
                vec3!(i => lanes.spread(given.velocity[i][k])),
            );
            let by = factor(&with_hat(&r, &xk), ak);
            put_row(&times(&by, &mobility), k, &mut space.o.0);
            // hat(a) hat(b) = b a^T - (a . b) I, transposed
            let (ox, xo) = (scaled(&omega, ak), scaled(&x, a_to));
            let mut d: Mat3<R> = mat3!(i, j => ox[i] * xk[j] + xo[i] * wk[j]);
            let trace = d[0][0] + d[1][1] + d[2][2];
            for i in 0..3 {
                d[i][i] = d[i][i] - trace;
            }
            put_row(&with(&r, &d), k, &mut space.h.0);
        }
        add_diagonal(&times(&alone(&q), &mobility), &mut space.o.0);
        let (px, qo) = (times_hat(&p, &x), times_hat(&q, &omega));
        let px: Mat3<R> = mat3!(i, j => px[j][i] + qo[j][i]);
        let own = alone(&px);
        let hessian = factor(&hessian, weight);
        add_diagonal(&mat3!(i, j => hessian[i][j] - own[i][j]), &mut space.h.0);

        // The rows of the end: [d-end], [d-Lambda] and [d-p1] by eta, then by dmu.
        let mut ends = [[0.0; ROWS]; 12];
        put_rows(&factor(&with_hat(&to_end, &omega), weight), 0, &mut ends);
        {
            // L(F, hat(Omega) hat(Lambda)) = -hat(Omega) F hat(Lambda) - (Omega . Lambda) L(F, I)
            let inner = times(&times(&hat(&omega), &to_end), &hat(&lambda_lanes));
            let (along, one) = (dot(&omega, &lambda_lanes), alone(&to_end));
            put_rows(&mat3!(i, j => -(weight * (inner[i][j] + along * one[i][j]))), 3, &mut ends);
        }
        let commutator = hat(&force);
        let forced: Mat3<R> = mat3!(i, j => weight * commutator[i][j] - hessian[i][j]);
        put_rows(&times(&to_end, &forced), 6, &mut ends);
        let by_turn: Mat3<R> = mat3!(c, r => dot(&hessian[r], &u[c]));
        put_rows(&by_turn, 9, &mut ends);
        let by_turn_at_end: Mat3<f64> = mat3!(i, c => (dot(&to_end[i], &by_turn[c])).sum());
        let mut by_momentum = [[0.0; ROWS]; 6];
        put_rows(&factor(&times(&alone(&to_end), &mobility), weight), 0, &mut by_momentum);
        put_rows(
            &factor(&times(&with_hat(&to_end, &lambda_lanes), &mobility), weight),
            3,
            &mut by_momentum,
        );

        for (r, row) in ends.iter_mut().enumerate() {
            *row = along::<L>(m, row, &space.z);
            if r < 6 {
                for c in 0..L {
                    row[c] += by_momentum[r][c];
                }
            }
        }
        reduce::<L>(m, space);
        for r in 0..3 {
            for c in 0..3 {
                for k in 0..k_lanes {
                    let present = if k < *stages {
                        weights[k] * inverse[r][c]
                    } else {
                        f64::from(u8::from(r == c))
                    };
                    space.system.0[r * k_lanes + k][c * k_lanes + k] += present;
                }
            }
        }
        let Space { system, lower, inverses, momenta, .. } = &mut *space;
        let momenta = &mut momenta.0;
        for i in 0..m {
            for c in 0..3 {
                momenta[i][c] = ends[3 + c][i];
                momenta[i][3 + c] = -ends[c][i];
                momenta[i][6 + c] = ends[9 + c][i];
            }
        }
        if !divide::<L, SIDES, SIDES>(m, &mut system.0, &mut lower.0, inverses, momenta) {
            return false;
        }
        // What remains: phi and dLambda.
        let mut by = [[0.0; SIDES]; 9];
        for (row, end) in by.iter_mut().zip(&ends) {
            let mut sum = [0.0; SIDES];
            for (x, side) in end[..m].iter().zip(&*momenta) {
                for c in 0..SIDES {
                    sum[c] += x * side[c];
                }
            }
            *row = sum;
        }
        let pl = times_hat(&p_end, &lambda);
        let trace = pl[0][0] + pl[1][1] + pl[2][2];
        let p1_hat = hat(&p1);
        let mut last = [[0.0; 8]; 6];
        let mut sides = [[0.0; 8]; 6];
        for r in 0..3 {
            for c in 0..3 {
                last[r][c] = q_end[r][c] - by[r][c];
                last[r][3 + c] = -by[r][3 + c];
                sides[r][c] = by[r][6 + c];
                let one = if r == c { trace } else { 0.0 };
                last[3 + r][c] = (pl[r][c] - one) + p1_hat[r][c] + (by[3 + r][c] + by[6 + r][c]);
                last[3 + r][3 + c] = q_end[r][c] + (by[3 + r][3 + c] + by[6 + r][3 + c]);
                sides[3 + r][c] = by_turn_at_end[r][c] - (by[3 + r][6 + c] + by[6 + r][6 + c]);
                sides[3 + r][3 + c] = -f[c][r];
            }
        }
        if !solve(&mut last, &mut sides) {
            return false;
        }
        space.end[..6].copy_from_slice(&sides);
        for r in 0..3 {
            space.end[6 + r] = [0.0; 8];
            space.end[6 + r][r] = 1.0;
        }
        let transition = &mut space.transition;
        for r in 0..3 {
            for c in 0..6 {
                let mut sum = 0.0;
                for i in 0..3 {
                    sum += p1_hat[r][i] * space.end[i][c];
                }
                for i in 0..9 {
                    sum += by[6 + r][i] * space.end[i][c];
                }
                transition[6 * r + c] = space.end[r][c];
                transition[6 * (3 + r) + c] = sum;
            }
            for c in 0..3 {
                transition[6 * r + c] += f[c][r];
                transition[6 * (3 + r) + c] -= by_turn_at_end[r][c];
                transition[6 * (3 + r) + 3 + c] += f[c][r];
            }
        }
        true
    }
}
