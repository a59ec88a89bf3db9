//! The matrices of the stages of a step side by side: one formula for all stages at once.
//!
//! An n x n matrix lies in memory row by row, each entry as the numbers of all lanes. Where there
//! are fewer lanes than a register holds, several columns go into one.
//!
//! Invariant: the result in a lane does not depend on the other lanes, nor on the instruction set.

use std::ops::{Deref, DerefMut, IndexMut};

use super::lanes::{Real, Row, StageScalar, Stored, WIDTH};

/// The number of rows, known to the compiler or not.
pub trait Dimension: Copy {
    /// n, if the compiler knows it.
    const KNOWN: Option<usize>;
    /// A vector.
    type Vector<R: Copy>: Copy + IndexMut<usize, Output = R>;
    /// n.
    fn n(self) -> usize;
    /// Returns the vector of n times the same number.
    fn vector<R: Copy>(self, value: R) -> Self::Vector<R>;
}

/// N rows.
#[derive(Clone, Copy, Debug)]
pub struct Known<const N: usize>;

impl<const N: usize> Dimension for Known<N> {
    const KNOWN: Option<usize> = Some(N);
    type Vector<R: Copy> = [R; N];

    #[inline(always)]
    fn vector<R: Copy>(self, value: R) -> [R; N] {
        [value; N]
    }

    #[inline(always)]
    fn n(self) -> usize {
        N
    }
}

/// The most rows that there are.
const LARGEST: usize = 32;

/// This many rows, up to 32.
#[derive(Clone, Copy, Debug)]
pub struct Any(pub usize);

impl Dimension for Any {
    const KNOWN: Option<usize> = None;
    type Vector<R: Copy> = [R; LARGEST];

    #[inline(always)]
    fn vector<R: Copy>(self, value: R) -> [R; LARGEST] {
        [value; LARGEST]
    }

    #[inline(always)]
    fn n(self) -> usize {
        self.0
    }
}

/// Numbers that begin where a line of the cache begins.
#[derive(Debug)]
pub struct AlignedBuffer {
    all: Vec<f64>,
    first: usize,
}

impl AlignedBuffer {
    /// `count` zeros.
    pub fn zeros(count: usize) -> Self {
        /// Bytes of a line.
        const LINE: usize = 64;
        let mut all = vec![0.0; count + LINE / size_of::<f64>()];
        let first = all.as_ptr().align_offset(LINE).min(LINE / size_of::<f64>());
        // Shorter where it lies: nothing moves.
        all.truncate(first + count);
        Self { all, first }
    }
}

impl Clone for AlignedBuffer {
    fn clone(&self) -> Self {
        let mut copy = Self::zeros(self.len());
        copy.copy_from_slice(self);
        copy
    }
}

impl Deref for AlignedBuffer {
    type Target = [f64];

    #[inline(always)]
    fn deref(&self) -> &[f64] {
        &self.all[self.first..]
    }
}

impl DerefMut for AlignedBuffer {
    #[inline(always)]
    fn deref_mut(&mut self) -> &mut [f64] {
        &mut self.all[self.first..]
    }
}

/// Arithmetic of n x n matrices in lanes.
#[derive(Clone, Copy, Debug)]
pub struct StageMatrices<R, D> {
    /// A number in as many lanes.
    pub lanes: R,
    /// n.
    pub dimension: D,
}

impl<R: Stored, D: Dimension> StageMatrices<R, D> {
    /// Groups of columns of a matrix, if the compiler knows n.
    const GROUPS: usize = match D::KNOWN {
        Some(n) => n / R::GROUP,
        None => usize::MAX,
    };

    /// n.
    #[inline(always)]
    pub fn n(self) -> usize {
        self.dimension.n()
    }

    /// The numbers of a matrix.
    #[inline(always)]
    pub fn numbers(self) -> usize {
        self.n() * self.n() * R::LANES
    }

    /// Entry i, j.
    #[inline(always)]
    pub fn get(self, m: &[f64], i: usize, j: usize) -> R {
        let at = (i * self.n() + j) * R::LANES;
        self.lanes.get(&m[at..at + R::LANES])
    }

    /// Sets entry i, j.
    #[inline(always)]
    pub fn put(self, m: &mut [f64], i: usize, j: usize, value: R) {
        let at = (i * self.n() + j) * R::LANES;
        value.put(&mut m[at..at + R::LANES]);
    }

    /// Sets entry i, j of a skew matrix, and j, i.
    #[inline(always)]
    pub fn put_skew(self, m: &mut [f64], i: usize, j: usize, value: R) {
        self.put(m, i, j, value);
        self.put(m, j, i, -value);
    }

    /// `C = A B`
    #[inline(always)]
    pub fn product(self, a: &[f64], b: &[f64], c: &mut [f64]) {
        self.multiplied::<false, false>(None, a, b, c);
    }

    /// `C = A^T B`, of which only the entries on and above the diagonal are meant.
    #[inline(always)]
    pub fn upper_of_transposed_product(self, a: &[f64], b: &[f64], c: &mut [f64]) {
        self.multiplied::<true, true>(None, a, b, c);
    }

    /// `C = S + A B`
    #[inline(always)]
    pub fn plus_product(self, s: &[f64], a: &[f64], b: &[f64], c: &mut [f64]) {
        self.multiplied::<false, false>(Some(s), a, b, c);
    }

    /// `C = S + A^T B`
    #[inline(always)]
    pub fn plus_transposed_product(self, s: &[f64], a: &[f64], b: &[f64], c: &mut [f64]) {
        self.multiplied::<true, false>(Some(s), a, b, c);
    }

    /// `C = S + A B`, or with `T` `S + A^T B`; with `UPPER` of each row the groups of columns from
    /// that of the diagonal on.
    #[inline(always)]
    fn multiplied<const T: bool, const UPPER: bool>(
        self,
        s: Option<&[f64]>,
        a: &[f64],
        b: &[f64],
        c: &mut [f64],
    ) {
        let n = self.n();
        let (a, b, c) = (&a[..self.numbers()], &b[..self.numbers()], &mut c[..self.numbers()]);
        let count = self.numbers();
        let s = s.map(
            #[inline(always)]
            |s| &s[..count],
        );
        let groups = n / R::GROUP;
        for i in 0..n {
            let mut group = if UPPER { i / R::GROUP } else { 0 };
            // As many at once as registers hold their sums. Arms that are never taken are not compiled.
            if const { !UPPER && Self::GROUPS == 5 } {
                self.groups::<5, T>(s, a, b, c, i, 0);
                group = 5;
            }
            if const { Self::GROUPS >= 4 } {
                while group + 4 <= groups {
                    self.groups::<4, T>(s, a, b, c, i, group);
                    group += 4;
                }
            }
            if const { !UPPER && Self::GROUPS != usize::MAX } {
                match const { Self::GROUPS % 4 } {
                    1 if const { Self::GROUPS != 5 } => self.groups::<1, T>(s, a, b, c, i, group),
                    2 => self.groups::<2, T>(s, a, b, c, i, group),
                    3 => self.groups::<3, T>(s, a, b, c, i, group),
                    _ => {}
                }
            } else {
                match groups - group {
                    1 => self.groups::<1, T>(s, a, b, c, i, group),
                    2 if const { Self::GROUPS >= 2 } => {
                        self.groups::<2, T>(s, a, b, c, i, group);
                    }
                    3 if const { Self::GROUPS >= 3 } => {
                        self.groups::<3, T>(s, a, b, c, i, group);
                    }
                    _ => {}
                }
            }
            for j in groups * R::GROUP..n {
                let mut sum = self.lanes.constant(0.0);
                for k in 0..n {
                    let x = if T { self.get(a, k, i) } else { self.get(a, i, k) };
                    sum = sum + x * self.get(b, k, j);
                }
                if let Some(s) = s {
                    sum = self.get(s, i, j) + sum;
                }
                self.put(c, i, j, sum);
            }
        }
    }

    /// `W` groups of columns of a row.
    #[inline(always)]
    fn groups<const W: usize, const T: bool>(
        self,
        s: Option<&[f64]>,
        a: &[f64],
        b: &[f64],
        c: &mut [f64],
        i: usize,
        first: usize,
    ) {
        let (n, lanes, wide) = (self.n(), self.lanes, R::GROUP * R::LANES);
        let mut sums = [lanes.get_wide(&a[..wide]).constant(0.0); W];
        for k in 0..n {
            let at = if T { k * n + i } else { i * n + k } * R::LANES;
            let x = lanes.repeated(&a[at..at + R::LANES]);
            let at = k * n * R::LANES + first * wide;
            let row = &b[at..at + W * wide];
            for j in 0..W {
                sums[j] = sums[j] + x * lanes.get_wide(&row[j * wide..(j + 1) * wide]);
            }
        }
        let at = i * n * R::LANES + first * wide;
        if let Some(s) = s {
            let row = &s[at..at + W * wide];
            for j in 0..W {
                sums[j] = lanes.get_wide(&row[j * wide..(j + 1) * wide]) + sums[j];
            }
        }
        let row = &mut c[at..at + W * wide];
        for j in 0..W {
            R::put_wide(sums[j], &mut row[j * wide..(j + 1) * wide]);
        }
    }

    /// `C = asym(A B^T)`, of which only the entries above the diagonal are written:
    /// `C_ij = sum_k A_ik B_jk - A_jk B_ik`.
    #[inline(always)]
    pub fn asym_of_product(self, a: &[f64], b: &[f64], c: &mut [f64]) {
        let n = self.n();
        let (a, b, c) = (&a[..self.numbers()], &b[..self.numbers()], &mut c[..self.numbers()]);
        for i in 0..n {
            let mut j = i + 1;
            // Three at once read row i once.
            while j + 3 <= n {
                self.asym_of_rows::<3>(a, b, c, i, j);
                j += 3;
            }
            match n - j {
                1 => self.asym_of_rows::<1>(a, b, c, i, j),
                2 => self.asym_of_rows::<2>(a, b, c, i, j),
                _ => {}
            }
        }
    }

    /// `W` entries of row i, from column j on.
    #[inline(always)]
    fn asym_of_rows<const W: usize>(self, a: &[f64], b: &[f64], c: &mut [f64], i: usize, j: usize) {
        let (n, lanes, width) = (self.n(), self.lanes, R::LANES);
        let wide = R::GROUP * width;
        let row = |i: usize| i * n * width..(i + 1) * n * width;
        let (a_i, b_i) = (&a[row(i)], &b[row(i)]);
        let (a_j, b_j) =
            (&a[j * n * width..(j + W) * n * width], &b[j * n * width..(j + W) * n * width]);
        let groups = n / R::GROUP;
        let mut sum = [lanes.constant(0.0); W];
        if groups > 0 {
            let mut sums = [lanes.get_wide(&a_i[..wide]).constant(0.0); W];
            for k in 0..groups {
                let at = k * wide..(k + 1) * wide;
                let (x, y) = (lanes.get_wide(&a_i[at.clone()]), lanes.get_wide(&b_i[at]));
                for m in 0..W {
                    let at = m * n * width + k * wide..m * n * width + (k + 1) * wide;
                    sums[m] = sums[m]
                        + (x * lanes.get_wide(&b_j[at.clone()]) - lanes.get_wide(&a_j[at]) * y);
                }
            }
            for m in 0..W {
                sum[m] = R::folded(sums[m]);
            }
        }
        for k in groups * R::GROUP..n {
            let (x, y) = (lanes.get(&a_i[k * width..]), lanes.get(&b_i[k * width..]));
            for m in 0..W {
                let at = (m * n + k) * width..(m * n + k + 1) * width;
                sum[m] = sum[m] + (x * lanes.get(&b_j[at.clone()]) - lanes.get(&a_j[at]) * y);
            }
        }
        for m in 0..W {
            self.put(c, i, j + m, sum[m]);
        }
    }

    /// `C = sym(A)`, the symmetric part.
    #[inline(always)]
    pub fn symmetric_part(self, a: &[f64], c: &mut [f64]) {
        let (a, c) = (&a[..self.numbers()], &mut c[..self.numbers()]);
        for i in 0..self.n() {
            for j in i..self.n() {
                let part = (self.get(a, i, j) + self.get(a, j, i)) * 0.5;
                self.put(c, i, j, part);
                self.put(c, j, i, part);
            }
        }
    }

    /// Adds to `F` half the defect of I + C from a rotation, `(I + C)^T (I + C) - I = C + C^T + C^T C`, in `room`.
    #[inline(always)]
    pub fn add_half_defect(self, c: &[f64], f: &mut [f64], room: &mut [f64]) {
        self.upper_of_transposed_product(c, c, room);
        let (c, f, room) =
            (&c[..self.numbers()], &mut f[..self.numbers()], &room[..self.numbers()]);
        for i in 0..self.n() {
            for j in i..self.n() {
                let defect = self.get(room, i, j) + (self.get(c, i, j) + self.get(c, j, i));
                let part = self.get(f, i, j) + defect * 0.5;
                self.put(f, i, j, part);
                self.put(f, j, i, part);
            }
        }
    }

    /// [F], [K] and [C] of docs/derivation.md: one step of Newton's method for the polar factor of `I + D`, with the derivative at
    /// P = I, from the current F.
    #[inline(always)]
    pub(crate) fn polar_factor(
        self,
        d: &[f64],
        c: &mut [f64],
        f: &mut [f64],
        k: &mut [f64],
        room: &mut [f64],
    ) {
        self.add_half_defect(c, f, room);
        self.plus_product(f, d, f, k);
        self.difference(d, k, c);
    }

    /// `C += a b^T - b a^T`, from zero if it is the `first`.
    #[inline(always)]
    pub fn add_wedge(self, first: bool, a: &D::Vector<R>, b: &D::Vector<R>, c: &mut [f64]) {
        let c = &mut c[..self.numbers()];
        for i in 0..self.n() {
            for j in i + 1..self.n() {
                let wedge = a[i] * b[j] - b[i] * a[j];
                let sum = if first { wedge } else { self.get(c, i, j) + wedge };
                self.put_skew(c, i, j, sum);
            }
        }
    }

    /// Writes a vector to memory, number by number.
    #[inline(always)]
    pub fn put_vector(self, v: &D::Vector<R>, to: &mut [f64]) {
        for (i, to) in to.chunks_exact_mut(R::LANES).enumerate() {
            v[i].put(to);
        }
    }

    /// `A` times a number for each lane.
    #[inline(always)]
    pub fn scale(self, x: R, a: &mut [f64]) {
        let wide = R::GROUP * R::LANES;
        let mut once = [0.0; WIDTH];
        x.put(&mut once);
        let x_wide = self.lanes.repeated(&once);
        let mut groups = a[..self.numbers()].chunks_exact_mut(wide);
        for group in &mut groups {
            R::put_wide(x_wide * self.lanes.get_wide(group), group);
        }
        for entry in groups.into_remainder().chunks_exact_mut(R::LANES) {
            (x * self.lanes.get(entry)).put(entry);
        }
    }

    /// `C_ij = A_ij B_ij`
    #[inline(always)]
    pub fn entrywise_product(self, a: &[f64], b: &[f64], c: &mut [f64]) {
        let (a, b, c) = (&a[..self.numbers()], &b[..self.numbers()], &mut c[..self.numbers()]);
        for e in 0..self.numbers() {
            c[e] = a[e] * b[e];
        }
    }

    /// The sum of the squares of all entries.
    #[inline(always)]
    pub fn square(self, a: &[f64]) -> R {
        let groups = a[..self.numbers()].chunks_exact(R::GROUP * R::LANES);
        let rest = groups.remainder();
        let mut sums = self.lanes.repeated(&[0.0; WIDTH]);
        for group in groups {
            let x = self.lanes.get_wide(group);
            sums = sums + x * x;
        }
        let mut sum = R::folded(sums);
        for entry in rest.chunks_exact(R::LANES) {
            let x = self.lanes.get(entry);
            sum = sum + x * x;
        }
        sum
    }

    /// `C = A - B`
    #[inline(always)]
    pub fn difference(self, a: &[f64], b: &[f64], c: &mut [f64]) {
        let (a, b, c) = (&a[..self.numbers()], &b[..self.numbers()], &mut c[..self.numbers()]);
        for e in 0..self.numbers() {
            c[e] = a[e] - b[e];
        }
    }

    /// `C = A + B`
    #[inline(always)]
    pub fn sum(self, a: &[f64], b: &[f64], c: &mut [f64]) {
        let (a, b, c) = (&a[..self.numbers()], &b[..self.numbers()], &mut c[..self.numbers()]);
        for e in 0..self.numbers() {
            c[e] = a[e] + b[e];
        }
    }
}

impl<R: StageScalar<StepScalar = f64>, D: Dimension> StageMatrices<R, D> {
    /// Returns the arithmetic for the step as a whole.
    #[inline(always)]
    pub fn whole(self) -> StageMatrices<f64, D> {
        StageMatrices { lanes: 0.0, dimension: self.dimension }
    }

    /// `C_k = sum_j columns[j]_k A_j`, k and j stages.
    #[inline(always)]
    pub fn combination(self, a: &[f64], columns: &[Row; WIDTH], c: &mut [f64]) {
        let columns = self.lanes.rows(columns);
        let (a, c) = (&a[..self.numbers()], &mut c[..self.numbers()]);
        for (a, c) in a.chunks_exact(R::LANES).zip(c.chunks_exact_mut(R::LANES)) {
            R::combination(a, &columns).put(c);
        }
    }

    /// `c = sum_k A_k`
    #[inline(always)]
    pub fn sum_of_stages(self, a: &[f64], c: &mut [f64]) {
        let (a, c) = (&a[..self.numbers()], &mut c[..self.n() * self.n()]);
        for (a, c) in a.chunks_exact(R::LANES).zip(c) {
            *c = self.lanes.get(a).sum();
        }
    }

    /// `C_k = a` at each stage.
    #[inline(always)]
    pub fn spread(self, a: &[f64], c: &mut [f64]) {
        let (a, c) = (&a[..self.n() * self.n()], &mut c[..self.numbers()]);
        for (a, c) in a.iter().zip(c.chunks_exact_mut(R::LANES)) {
            self.lanes.spread(*a).put(c);
        }
    }
}
