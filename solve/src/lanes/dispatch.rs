//! Work in lanes, compiled for the instruction sets on which it gains, and done on the widest that there is.

use fearless_simd::Level;

/// Does the work in lanes of a wide instruction set, compiled for it, if there is one; else the other.
// Not for every instruction set: a piece of work is compiled once for each. The additional
// registers of AVX-512 make few lanes of n = 3 faster by a tenth, and four lanes of n = 16; two
// lanes of matrices gain nothing.
macro_rules! widest {
    (@on $token:ident, $vector:ident, $lanes:ident => $work:expr) => {{
        $token.vectorize(
            #[inline(always)]
            || {
                let $lanes = $vector::splat($token, 0.0);
                $work
            },
        )
    }};
    ($level:expr, $vector:ident, $lanes:ident => $work:expr, else $other:expr) => {
        match $level {
            #[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
            fearless_simd::Level::Avx512(token) => widest!(@on token, $vector, $lanes => $work),
            #[allow(unreachable_patterns)]
            level => widest!(level below Avx512, $vector, $lanes => $work, else $other),
        }
    };
    ($level:ident below Avx512, $vector:ident, $lanes:ident => $work:expr, else $other:expr) => {{
        #[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
        let token = fearless_simd::Level::as_avx2($level);
        #[cfg(target_arch = "aarch64")]
        let token = fearless_simd::Level::as_neon($level);
        #[cfg(not(any(target_arch = "x86", target_arch = "x86_64", target_arch = "aarch64")))]
        let token = Some($level).and(None::<fearless_simd::Fallback>);
        match token {
            Some(token) => widest!(@on token, $vector, $lanes => $work),
            None => $other,
        }
    }};
}

/// What a piece of work is compiled for besides the terms of a potential, as a set of bits. A call keeps no register, and
/// more code needs more of them: either costs a plain body a tenth of its time, so it has work without them.
pub(crate) mod extras {
    /// User-defined potentials.
    pub(crate) const USER: u8 = 1;
    /// Drives and wheels.
    pub(crate) const DRIVEN: u8 = 2;
}

/// Does the work on the stages of a step in as many lanes as they need, compiled for the widest instruction set; or
/// one number at a time. The last type parameter of the work is the set of [`extras`]. With user-defined potentials lanes are
/// compiled for many stages only, where they save a third. For work marked `also DRIVEN`, bodies may be driven or have wheels.
macro_rules! in_stage_lanes {
    (@call $module:ident::$work:ident, $extras:expr, $lanes:expr, ($($argument:expr),*)) => {
        $module::$work::<_, { $extras }>($lanes, $($argument),*)
    };
    (@in $level:expr, $stages:expr, $body:expr, $module:ident::$work:ident, [$($driven:ident)?], $arguments:tt) => {{
        use $crate::lanes::extras::*;
        let in_lanes = match ($level, $stages, $body.extras()) {
            (Some(level), 2, 0) => widest!(
                level, f64x2,
                lanes => Some(in_stage_lanes!(@call $module::$work, 0, lanes, $arguments)), else None
            ),
            (Some(level), 3 | 4, 0) => widest!(
                level, f64x4,
                lanes => Some(in_stage_lanes!(@call $module::$work, 0, lanes, $arguments)), else None
            ),
            (Some(level), 5.., 0) => widest!(
                level, f64x8,
                lanes => Some(in_stage_lanes!(@call $module::$work, 0, lanes, $arguments)), else None
            ),
            (Some(level), 5.., USER) => widest!(
                level below Avx512, f64x8,
                lanes => Some(in_stage_lanes!(@call $module::$work, USER, lanes, $arguments)), else None
            ),
            $(
                (Some(level), 2, $driven) => widest!(
                    level below Avx512, f64x2,
                    lanes => Some(in_stage_lanes!(@call $module::$work, $driven, lanes, $arguments)), else None
                ),
                (Some(level), 3 | 4, $driven) => widest!(
                    level below Avx512, f64x4,
                    lanes => Some(in_stage_lanes!(@call $module::$work, $driven, lanes, $arguments)), else None
                ),
                (Some(level), 5.., $driven) => widest!(
                    level below Avx512, f64x8,
                    lanes => Some(in_stage_lanes!(@call $module::$work, $driven, lanes, $arguments)), else None
                ),
            )?
            _ => None,
        };
        // Each call is written once: compiling it takes long.
        match (in_lanes, $stages) {
            (Some(done), _) => done,
            (None, 1) => in_stage_lanes!(@call $module::$work, USER $(| $driven)?, Rows([0.0; 1]), $arguments),
            (None, 2) => in_stage_lanes!(@call $module::$work, USER $(| $driven)?, Rows([0.0; 2]), $arguments),
            (None, 3 | 4) => in_stage_lanes!(@call $module::$work, USER $(| $driven)?, Rows([0.0; 4]), $arguments),
            (None, _) => in_stage_lanes!(@call $module::$work, USER $(| $driven)?, Rows([0.0; 8]), $arguments),
        }
    }};
    (
        $level:expr, $stages:expr, $body:expr, $module:ident::$work:ident $(also $driven:ident)?, $($argument:expr),*
    ) => {
        in_stage_lanes!(@in $level, $stages, $body, $module::$work, [$($driven)?], ($($argument),*))
    };
}

/// Does the work on five to eight stages, like `in_stage_lanes`, for bodies that may be driven or have wheels.
macro_rules! in_eight_stage_lanes {
    ($level:expr, $body:expr, $module:ident::$work:ident, $($argument:expr),*) => {{
        use $crate::lanes::extras::*;
        let in_lanes = match ($level, $body.extras()) {
            (Some(level), 0) => widest!(
                level, f64x8, lanes => Some($module::$work::<_, 0>(lanes, $($argument),*)), else None
            ),
            (Some(level), USER) => widest!(
                level below Avx512, f64x8,
                lanes => Some($module::$work::<_, USER>(lanes, $($argument),*)), else None
            ),
            (Some(level), DRIVEN) => widest!(
                level below Avx512, f64x8,
                lanes => Some($module::$work::<_, DRIVEN>(lanes, $($argument),*)), else None
            ),
            _ => None,
        };
        match in_lanes {
            Some(done) => done,
            None => $module::$work::<_, { USER | DRIVEN }>(Rows([0.0; 8]), $($argument),*),
        }
    }};
}

/// Methods of a type with a method `lanes` whose bodies are compiled for the instruction set of these lanes, each once.
macro_rules! in_lanes {
    ($($(#[$attribute:meta])* $visible:vis fn $name:ident(&mut $this:ident $(, $argument:ident: $type:ty)*) $(-> $result:ty)? $body:block)*) => {
        $($(#[$attribute])*
        #[inline(never)]
        $visible fn $name(&mut $this $(, $argument: $type)*) $(-> $result)? {
            $this.lanes().vectorized(
                #[inline(always)]
                || $body,
            )
        })*
    };
}

/// Compiles work on members for the instruction sets on which lanes gain, and does it on the widest; `$lanes` is
/// `$stages` stages in lanes, and `EXTRAS` the set of extras that it is compiled for.
macro_rules! in_member_lanes {
    ($level:ident, $stages:literal, $extras:ident, $lanes:ident => $work:expr) => {{
        #[cfg(target_arch = "x86_64")]
        match ($extras, $level.as_avx512(), $level.as_avx2()) {
            (0, Some(simd), _) => in_member_lanes!(@on simd, $stages, 0, $lanes => $work),
            (0, None, Some(simd)) => in_member_lanes!(@on simd, $stages, 0, $lanes => $work),
            (_, _, Some(simd)) => in_member_lanes!(@on simd, $stages, { $crate::lanes::extras::DRIVEN }, $lanes => $work),
            (_, _, None) => unreachable!("members go by themselves here"),
        }
        #[cfg(not(target_arch = "x86_64"))]
        unreachable!("members go by themselves here")
    }};
    (@on $simd:ident, $stages:literal, $extras:expr, $lanes:ident => $work:expr) => {
        $simd.vectorize(
            #[inline(always)]
            || {
                #[allow(dead_code, reason = "not all work has extras")]
                const EXTRAS: u8 = $extras;
                let zero = fearless_simd::f64x8::from_slice($simd, &$crate::lanes::aligned_zero().0);
                let $lanes = $crate::lanes::Rows([zero; $stages]);
                $work
            },
        )
    };
}

/// Is this an instruction set on which members side by side gain?
pub(crate) fn has_member_lanes(level: Option<Level>) -> bool {
    #[cfg(target_arch = "x86_64")]
    return level.is_some_and(|level| level.as_avx2().is_some());
    #[cfg(not(target_arch = "x86_64"))]
    return false;
}

pub(crate) use {in_eight_stage_lanes, in_lanes, in_member_lanes, in_stage_lanes, widest};
