//! Times of a run, and the phases that belong to them.
//!
//! Invariant: a phase is right to the rounding of a turn, however late the time.

/// A time: the beginning of a step, and the time since. Their sum would be rounded to the
/// resolution of a clock late in a run, which is a noise in every phase.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Time {
    begun: f64,
    after: f64,
    /// Time whose piece of a table counts. In a step it is the middle: at its two ends the polynomial of the step counts, and
    /// not the one before or after it.
    pub(crate) piece_at: f64,
}

/// Times that differ by no more than this are the same: `k h` is a rounding away from what was meant.
pub(crate) fn rounding_s(t: f64) -> f64 {
    8.0 * f64::EPSILON * t.abs()
}

impl Time {
    /// A time as an observer sees it: at a knot, what comes after it.
    pub(crate) fn of(t: f64) -> Self {
        Self { begun: t, after: 0.0, piece_at: t + rounding_s(t) }
    }

    /// The time just before a knot, as it is seen from there.
    pub(crate) fn before(knot: f64) -> Self {
        Self { piece_at: knot - rounding_s(knot), ..Self::of(knot) }
    }

    /// The time `after` seconds from the beginning of a step of length `h`.
    pub(crate) fn in_step(begun: f64, h: f64, after: f64) -> Self {
        Self { begun, after, piece_at: begun + 0.5 * h }
    }

    pub(crate) fn seconds(self) -> f64 {
        self.begun + self.after
    }

    /// Seconds since another time, near this one.
    pub(crate) fn since(self, earlier_s: f64) -> f64 {
        (self.begun - earlier_s) + self.after
    }

    /// `rate t + phase` less whole turns, to round-off of a turn however late it is.
    pub(crate) fn angle(self, rate: f64, phase: f64) -> f64 {
        /// 2 pi in three parts (Cody and Waite 1980): the first has 24 bits, and its product with the turns is exact.
        const HIGH: f64 = 6.283_185_482_025_146_5;
        const LOW: f64 = std::f64::consts::TAU - HIGH;
        const LOWEST: f64 = 2.449_293_598_294_706_4e-16;
        let angle = rate * self.begun;
        let rounded_off = libm::fma(rate, self.begun, -angle);
        let turns = libm::round(angle / std::f64::consts::TAU);
        let rest = ((angle - turns * HIGH) - turns * LOW) - turns * LOWEST;
        rest + (rounded_off + rate * self.after) + phase
    }
}
