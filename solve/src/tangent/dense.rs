//! Matrices of a size known at run time, row by row, and their factors.
//!
//! Plain loops in a fixed order, without fused operations: the same bits on every machine.

/// A matrix, row by row.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Dense {
    columns: usize,
    numbers: Vec<f64>,
}

impl Dense {
    pub(super) fn zeros(rows: usize, columns: usize) -> Self {
        Self { columns, numbers: vec![0.0; rows * columns] }
    }

    /// A matrix of these numbers, row by row.
    pub(super) fn of(columns: usize, numbers: Vec<f64>) -> Self {
        Self { columns, numbers }
    }

    pub(super) fn into_numbers(self) -> Vec<f64> {
        self.numbers
    }

    pub(super) fn rows(&self) -> usize {
        self.numbers.len() / self.columns
    }

    pub(super) fn row(&self, i: usize) -> &[f64] {
        &self.numbers[i * self.columns..][..self.columns]
    }

    pub(super) fn row_mut(&mut self, i: usize) -> &mut [f64] {
        &mut self.numbers[i * self.columns..][..self.columns]
    }

    pub(super) fn numbers(&self) -> &[f64] {
        &self.numbers
    }

    /// Adds `A B`. Zeros of A are passed over: many of its blocks are empty.
    pub(super) fn add_product(&mut self, a: &Self, b: &Self) {
        for i in 0..a.rows() {
            let sum = self.row_mut(i);
            for (k, &x) in a.row(i).iter().enumerate() {
                if x != 0.0 {
                    add_scaled(sum, b.row(k), x);
                }
            }
        }
    }

    /// `x^T A`.
    pub(super) fn transposed_times(&self, x: &[f64]) -> Vec<f64> {
        let mut sum = vec![0.0; self.columns];
        for (i, &x) in x.iter().enumerate() {
            add_scaled(&mut sum, self.row(i), x);
        }
        sum
    }
}

/// `sum + x row`, in place.
#[inline(always)]
pub(super) fn add_scaled(sum: &mut [f64], row: &[f64], x: f64) {
    for (sum, entry) in sum.iter_mut().zip(row) {
        *sum += x * entry;
    }
}

/// `K = Pi^T L U`: the factors of a square matrix by elimination with row pivots.
#[derive(Clone, Debug)]
pub(super) struct Factors {
    /// U on and above the diagonal, which holds the inverse of its entries; L below, its diagonal being one.
    factors: Dense,
    /// The row of K that became row i.
    order: Vec<usize>,
}

impl Factors {
    /// Factors `k`. `None` if it is singular to working precision or not finite.
    pub(super) fn of(mut k: Dense) -> Option<Self> {
        let m = k.rows();
        let mut order: Vec<usize> = (0..m).collect();
        let largest = k.numbers.iter().fold(0.0_f64, |size, x| size.max(x.abs()));
        for j in 0..m {
            let size = |i: usize| k.row(i)[j].abs();
            let pivot = (j + 1..m).fold(j, |best, i| if size(i) > size(best) { i } else { best });
            if !(size(pivot) > f64::EPSILON * largest) {
                return None;
            }
            if pivot != j {
                order.swap(pivot, j);
                let (above, below) = k.numbers.split_at_mut(pivot * m);
                above[j * m..][..m].swap_with_slice(&mut below[..m]);
            }
            let (above, below) = k.numbers.split_at_mut((j + 1) * m);
            let row = &mut above[j * m..];
            row[j] = 1.0 / row[j];
            for other in below.chunks_exact_mut(m) {
                let factor = other[j] * row[j];
                if factor != 0.0 {
                    other[j] = factor;
                    add_scaled(&mut other[j + 1..], &row[j + 1..], -factor);
                }
            }
        }
        k.numbers.iter().all(|x| x.is_finite()).then_some(Self { factors: k, order })
    }

    /// `K^-1 rhs`, for several columns.
    pub(super) fn solve(&self, rhs: &Dense) -> Dense {
        let m = self.order.len();
        let columns = rhs.columns;
        let mut x = Dense::zeros(m, columns);
        for i in 0..m {
            x.row_mut(i).copy_from_slice(rhs.row(self.order[i]));
            let (above, below) = x.numbers.split_at_mut(i * columns);
            for (j, &l) in self.factors.row(i)[..i].iter().enumerate() {
                add_scaled(&mut below[..columns], &above[j * columns..][..columns], -l);
            }
        }
        for i in (0..m).rev() {
            let (above, below) = x.numbers.split_at_mut((i + 1) * columns);
            let (row, upper) = (&mut above[i * columns..], self.factors.row(i));
            for (j, &u) in upper[i + 1..].iter().enumerate() {
                add_scaled(row, &below[j * columns..][..columns], -u);
            }
            row.iter_mut().for_each(|x| *x *= upper[i]);
        }
        x
    }
}
