//! Tables over time: cubics, lines or steps between knots, with their integrals.

use super::Time;
use crate::failure::{Failure, FailureCode};

/// How a table goes from one of its values to the next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Interpolation {
    /// Cubic and monotone between two values, with a continuous rate: it never leaves the range of the two
    /// (Fritsch and Butland 1984, SIAM J. Sci. Stat. Comput. 5, with the weights of Brodlie; ends by three points).
    Monotone,
    /// Straight, with corners at the times.
    Linear,
    /// Each value holds from its time to the next.
    Hold,
}

/// Values at given times, and between them. Two equal times are a jump, from the first value to the second.
///
/// A table is one polynomial from each of its times to the next. At a time where these differ, a knot, the time loop ends a
/// step ([`crate::system::System::next_knot`]); so within a step only one piece counts.
#[derive(Clone, Debug, PartialEq)]
pub struct Table<const M: usize> {
    times: Vec<f64>,
    values: Vec<[f64; M]>,
    interpolation: Interpolation,
    /// Times at which it is not one polynomial, its first and last among them.
    knots: Vec<f64>,
    /// Integrals of the values from the first time to each.
    integrals: Vec<[f64; M]>,
}

/// A piece of a table as a cubic of `x = t - begins`: `c_0 + x (c_1 + x (c_2 + x c_3))`.
struct Piece<const M: usize> {
    begins: f64,
    coefficients: [[f64; 4]; M],
}

impl<const M: usize> Table<M> {
    /// Creates a table of values (one row for each time) at times in seconds: two or more, ascending, at most two of them equal.
    pub fn new(times: Vec<f64>, values: Vec<[f64; M]>, interpolation: Interpolation) -> Self {
        let (knots, integrals) = (Vec::new(), vec![[0.0; M]]);
        let mut table = Self { times, values, interpolation, knots, integrals };
        let places = 0..table.times.len();
        table.knots = places.filter(|&i| table.is_knot(i)).map(|i| table.times[i]).collect();
        for k in 1..table.times.len() {
            let width = table.times[k] - table.times[k - 1];
            let part = if width > 0.0 { table.piece(k).integral(width) } else { [0.0; M] };
            let sum = std::array::from_fn(|m| table.integrals[k - 1][m] + part[m]);
            table.integrals.push(sum);
        }
        table
    }

    /// The times in seconds at which it changes its polynomial, its first and last among them.
    pub fn knots(&self) -> &[f64] {
        &self.knots
    }

    /// Refuses a time that is not covered, but for a rounding: the last step of a run ends one away from its end.
    pub(super) fn check(&self, t: f64) -> Result<(), Failure> {
        const ROUNDING: f64 = 1e-9;
        let (first, last) = (self.times[0], self.times[self.times.len() - 1]);
        let near = ROUNDING * (last - first);
        if t >= first - near && t <= last + near {
            return Ok(());
        }
        let limit = if t < first { first } else { last };
        Err(Failure::new(FailureCode::OutsideTable, None, t, limit))
    }

    /// The values at a time, and their rates, by the piece that counts ([`Time`]). Before its first time and after its last a
    /// table stays as it is there: see [`Table::check`].
    pub(in crate::hamiltonian) fn at(&self, t: Time) -> ([f64; M], [f64; M]) {
        let Piece { begins, coefficients } = self.piece(self.reached(t.piece_at));
        let x = t.since(begins);
        let value = coefficients.map(|[c, p, q, r]| c + x * (p + x * (q + x * r)));
        let rate = coefficients.map(|[_, p, q, r]| p + x * (2.0 * q + x * (3.0 * r)));
        (value, rate)
    }

    /// The number of its times that are not later than `t`.
    fn reached(&self, t: f64) -> usize {
        self.times.partition_point(|&time| time <= t)
    }

    /// The piece that begins at the last of the first `reached` times.
    fn piece(&self, reached: usize) -> Piece<M> {
        let last = self.times.len() - 1;
        let stays = |i: usize| Piece {
            begins: self.times[i],
            coefficients: self.values[i].map(|value| [value, 0.0, 0.0, 0.0]),
        };
        if reached == 0 || reached > last || self.interpolation == Interpolation::Hold {
            return stays(reached.saturating_sub(1));
        }
        let k = reached - 1;
        let width = self.times[k + 1] - self.times[k];
        let coefficients = std::array::from_fn(|m| {
            let value = self.values[k][m];
            let chord = self.chord(k, m);
            if self.interpolation == Interpolation::Linear {
                return [value, chord, 0.0, 0.0];
            }
            // Hermite's cubic.
            let (p, q) = (self.slope(k, true, m), self.slope(k + 1, false, m));
            let bend = (p + q - 2.0 * chord) / width;
            [value, p, (chord - p) / width - bend, bend / width]
        });
        Piece { begins: self.times[k], coefficients }
    }

    /// The slope of the straight line of piece `k`.
    fn chord(&self, k: usize, m: usize) -> f64 {
        (self.values[k + 1][m] - self.values[k][m]) / (self.times[k + 1] - self.times[k])
    }

    /// The slope of the monotone cubic at time `i`, of the piece after it or before it; the two are the same but at a jump.
    fn slope(&self, i: usize, after: bool, m: usize) -> f64 {
        // Is there a piece from time k on, other than a jump?
        let width = |k: Option<usize>| {
            let k = k?;
            let width = self.times.get(k + 1)? - self.times[k];
            (width > 0.0).then_some((k, width))
        };
        let (before, next) = (width(i.checked_sub(1)), width(Some(i)));
        match (before, next) {
            (Some((j, low)), Some((k, high))) => {
                let (d, e) = (self.chord(j, m), self.chord(k, m));
                // An extremum is flat; else the weighted harmonic mean of the two chords.
                if !(d * e > 0.0) {
                    return 0.0;
                }
                let (u, v) = (2.0 * high + low, high + 2.0 * low);
                (u + v) / (u / d + v / e)
            }
            // At an end, or a jump: the parabola through three points, as far as it stays monotone.
            _ => {
                let (own, other) = if after {
                    (next, width(Some(i + 1)))
                } else {
                    (before, width(i.checked_sub(2)))
                };
                let Some((k, near)) = own else { return 0.0 };
                let d = self.chord(k, m);
                let Some((j, far)) = other else { return d };
                let e = self.chord(j, m);
                let slope = ((2.0 * near + far) * d - near * e) / (near + far);
                if slope * d <= 0.0 {
                    0.0
                } else if d * e < 0.0 && slope.abs() > 3.0 * d.abs() {
                    3.0 * d
                } else {
                    slope
                }
            }
        }
    }

    /// Is the polynomial after time `i` another one than that before?
    fn is_knot(&self, i: usize) -> bool {
        let last = self.times.len() - 1;
        if i == 0 || i == last || self.is_jump(i) {
            return true;
        }
        let level = |k: usize| self.values[k] == self.values[k + 1];
        match self.interpolation {
            Interpolation::Hold => !level(i - 1),
            Interpolation::Linear => (0..M).any(|m| self.chord(i - 1, m) != self.chord(i, m)),
            Interpolation::Monotone => !(level(i - 1) && level(i)),
        }
    }

    /// Is time `i` one of two that are equal?
    fn is_jump(&self, i: usize) -> bool {
        let same = |k: usize| self.times.get(k) == Some(&self.times[i]);
        same(i + 1) || i > 0 && same(i - 1)
    }

    /// The exact integral of the values from its first time to `t`.
    pub(super) fn integral(&self, t: f64) -> [f64; M] {
        let reached = self.reached(t);
        let k = reached.saturating_sub(1);
        let part = self.piece(reached).integral(t - self.times[k]);
        std::array::from_fn(|m| self.integrals[k][m] + part[m])
    }
}

impl<const M: usize> Piece<M> {
    /// The integral of the first `x` seconds.
    fn integral(&self, x: f64) -> [f64; M] {
        self.coefficients.map(|[c, p, q, r]| x * (c + x * (p / 2.0 + x * (q / 3.0 + x * r / 4.0))))
    }
}
