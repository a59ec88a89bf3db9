//! Form and range of what stands in more than one field: numbers, points, directions, matrices.

use super::{Attitude, Entry, Framed, Inertia, ScenarioError};

/// Largest size of any number of a scene.
pub(crate) const MAX_SIZE: f64 = 1e15;
/// Smallest size of a vector that is not zero: its square, and that of what follows from it, is
/// still a number.
pub(super) const SMALLEST_SIZE: f64 = 1e-15;
/// Smallest strength of a term that is not zero.
pub(crate) const SMALLEST_STRENGTH: f64 = 1e-30;
/// Largest seed: JSON numbers are exact up to here.
pub(crate) const LARGEST_SEED: u64 = (1 << 53) - 1;
/// Most steps of a run.
pub(super) const MAX_STEPS: u64 = 1_000_000_000_000;
/// Smallest step in seconds.
pub(crate) const SMALLEST_STEP_S: f64 = 1e-12;
/// Largest step in seconds.
pub(super) const LARGEST_STEP_S: f64 = 1e9;

/// Largest n of SO(n) that the program is built for.
const MAX_DIMENSION: usize = 16;
/// The one n beyond it for which the program is also built: each n costs a fifteenth of the
/// program's build.
const LARGE_DIMENSION: usize = 32;
/// Largest angle of an attitude: more turns would leave less than ten digits.
const MOST_ANGLE_RAD: f64 = 1e6;
const MOST_ANGLE_DEG: f64 = 1e8;
/// Largest modified Rodrigues parameter, a full turn but for a billionth.
const MOST_MRP: f64 = 1e9;

/// Result of a check.
pub(crate) type Check = Result<(), ScenarioError>;

/// Refuses the field at `pointer` unless the condition holds.
pub(crate) fn ensure(
    condition: bool,
    pointer: impl Into<String>,
    message: impl FnOnce() -> String,
) -> Check {
    if condition { Ok(()) } else { Err(ScenarioError::invalid(pointer, message())) }
}

pub(super) fn number(pointer: &str, x: f64) -> Check {
    // JSON has no NaN; an infinite value cannot be written either.
    ensure(x.abs() <= MAX_SIZE, pointer, || {
        format!("{x:?} given, the size of a number is at most {MAX_SIZE:e}")
    })
}

pub(super) fn vector(pointer: &str, given: &[f64], n: usize) -> Check {
    ensure(given.len() == n, pointer, || {
        format!("{} numbers given, n = {n} are needed", given.len())
    })?;
    given.iter().enumerate().try_for_each(|(i, &x)| number(&format!("{pointer}/{i}"), x))
}

/// Checks that a number is zero, or not so small that what is made of it is lost.
pub(super) fn strength(pointer: &str, x: f64) -> Check {
    number(pointer, x)?;
    ensure(x == 0.0 || x.abs() >= SMALLEST_STRENGTH, pointer, || {
        format!("{x:?} given, a size is 0 or at least {SMALLEST_STRENGTH:e}")
    })
}

/// Checks a standard deviation.
pub(super) fn spread(pointer: &str, x: f64, most: f64) -> Check {
    ensure((0.0..=most).contains(&x), pointer, || {
        format!("{x:?} given, a spread must be from 0 to {most:?}")
    })?;
    ensure(x == 0.0 || x >= SMALLEST_SIZE, pointer, || {
        format!("{x:?} given, a spread is 0 or at least {SMALLEST_SIZE:e}")
    })
}

/// Returns the lower triangular L of a covariance or correlation matrix `A = L L^T` (Cholesky). A pivot that is zero but for
/// rounding leaves a column of zeros, so a part that is certain, or that follows from others, is none to refuse.
pub(crate) fn semidefinite(
    pointer: &str,
    given: &[Vec<f64>],
) -> Result<Vec<Vec<f64>>, ScenarioError> {
    const ROUNDING: f64 = 1e-12;
    symmetry(pointer, given, 1.0, "symmetric")?;
    let n = given.len();
    let mut factor = vec![vec![0.0; n]; n];
    for j in 0..n {
        let variance = given[j][j];
        ensure(variance >= 0.0, format!("{pointer}/{j}/{j}"), || {
            format!("{variance:?} given, a variance is not negative")
        })?;
        let row: Vec<f64> = factor[j][..j].to_vec();
        let rest = |i: usize, factor: &[Vec<f64>]| {
            let pairs = row.iter().zip(&factor[i]);
            pairs.fold(given[i][j], |rest, (a, b)| rest - a * b)
        };
        let pivot = rest(j, &factor);
        let is_zero = pivot <= ROUNDING * variance;
        let size = |i: usize| (variance * given[i][i].max(0.0)).sqrt();
        let is_possible = pivot >= -ROUNDING * variance
            && (!is_zero || (j..n).all(|i| rest(i, &factor).abs() <= ROUNDING.sqrt() * size(i)));
        ensure(is_possible, pointer, || {
            format!(
                "is not positive semidefinite, by its first {} rows and the columns below",
                j + 1
            )
        })?;
        if !is_zero {
            for i in j..n {
                factor[i][j] = rest(i, &factor) / pivot.sqrt();
            }
        }
    }
    Ok(factor)
}

/// Returns the largest size of the numbers.
pub(super) fn largest<'a>(numbers: impl IntoIterator<Item = &'a f64>) -> f64 {
    numbers.into_iter().fold(0.0, |largest, x| x.abs().max(largest))
}

/// Refuses numbers that are not all zero, but all close to it.
pub(super) fn size<'a>(pointer: &str, numbers: impl IntoIterator<Item = &'a f64>) -> Check {
    let largest = largest(numbers);
    ensure(largest == 0.0 || largest >= SMALLEST_SIZE, pointer, || {
        format!(
            "has {largest:e} as its largest number; all must be 0, or one must be at least {SMALLEST_SIZE:e}"
        )
    })
}

pub(super) fn point(pointer: &str, given: &[f64], n: usize) -> Check {
    vector(pointer, given, n)?;
    size(pointer, given)
}

pub(super) fn direction(pointer: &str, given: &[f64], n: usize) -> Check {
    vector(pointer, given, n)?;
    let largest = largest(given);
    ensure(largest >= SMALLEST_SIZE, pointer, || {
        format!(
            "has {largest:e} as its largest number; a direction needs one of at least {SMALLEST_SIZE:e}"
        )
    })
}

pub(super) fn matrix(pointer: &str, given: &[Vec<f64>], n: usize) -> Check {
    ensure(given.len() == n, pointer, || {
        format!("{} rows given, n = {n} are needed", given.len())
    })?;
    given.iter().enumerate().try_for_each(|(i, row)| vector(&format!("{pointer}/{i}"), row, n))
}

/// Checks that a matrix is symmetric (`sign` +1) or skew (`sign` -1).
pub(super) fn symmetry(pointer: &str, given: &[Vec<f64>], sign: f64, word: &str) -> Check {
    let size = largest(given.iter().flatten());
    for (i, row) in given.iter().enumerate() {
        for (j, &x) in row.iter().enumerate().take(i + 1) {
            let partner = sign * given[j][i];
            ensure((x - partner).abs() <= 1e-12 * size, format!("{pointer}/{i}/{j}"), || {
                format!("{x} given, {partner} is needed: the matrix must be {word}")
            })?;
        }
    }
    Ok(())
}

pub(super) fn framed(pointer: &str, given: &Framed, n: usize) -> Check {
    let (frame, entries) = match given {
        Framed::Body(entries) => ("body", entries),
        Framed::Space(entries) => ("space", entries),
    };
    let pointer = format!("{pointer}/{frame}");
    let shape = |i: usize| {
        let allowed = if n == 3 {
            "3 numbers or a skew 3 x 3 matrix".to_owned()
        } else {
            format!("a skew {n} x {n} matrix")
        };
        ScenarioError::invalid(
            format!("{pointer}/{i}"),
            format!("numbers and rows are mixed; {allowed} is needed"),
        )
    };
    if matches!(entries.first(), Some(Entry::Number(_))) {
        ensure(n == 3, pointer.clone(), || {
            format!("is a vector, which is for n = 3; n = {n} needs a skew {n} x {n} matrix")
        })?;
        let mut numbers = Vec::new();
        for (i, entry) in entries.iter().enumerate() {
            match entry {
                Entry::Number(x) => numbers.push(*x),
                Entry::Row(_) => return Err(shape(i)),
            }
        }
        return point(&pointer, &numbers, 3);
    }
    let mut rows = Vec::new();
    for (i, entry) in entries.iter().enumerate() {
        match entry {
            Entry::Row(row) => rows.push(row.clone()),
            Entry::Number(_) => return Err(shape(i)),
        }
    }
    matrix(&pointer, &rows, n)?;
    size(&pointer, rows.iter().flatten())?;
    symmetry(&pointer, &rows, -1.0, "skew")
}

/// Checks an attitude that stands at `at`.
pub(super) fn attitude(at: &str, given: &Attitude, n: usize) -> Check {
    let only_three = |pointer: String| {
        ensure(n == 3, pointer, || format!("is for n = 3, this body has n = {n}: use `matrix`"))
    };
    match given {
        Attitude::Matrix(rows) => matrix(&format!("{at}/matrix"), rows, n)?,
        Attitude::Quaternion(q) => {
            let pointer = format!("{at}/quaternion");
            only_three(pointer.clone())?;
            vector(&pointer, q, 4)?;
            let norm = q.iter().map(|x| x * x).sum::<f64>().sqrt();
            ensure((norm - 1.0).abs() <= 0.01, pointer, || {
                format!("has the norm {norm}, it must be within 1 % of 1")
            })?;
        }
        Attitude::AxisAngle(turn) => {
            let pointer = format!("{at}/axis_angle");
            only_three(pointer.clone())?;
            direction(&format!("{pointer}/axis"), &turn.axis, 3)?;
            let given = [turn.angle_rad, turn.angle_deg];
            angles(&pointer, "angle", given.map(|angle| angle.map(|angle| [angle])))?;
        }
        Attitude::Euler(euler) => {
            let pointer = format!("{at}/euler");
            only_three(pointer.clone())?;
            angles(&pointer, "angles", [euler.angles_rad, euler.angles_deg])?;
        }
        Attitude::RollPitchYaw(turns) => {
            let pointer = format!("{at}/roll_pitch_yaw");
            only_three(pointer.clone())?;
            angles(&pointer, "angles", [turns.angles_rad, turns.angles_deg])?;
        }
        Attitude::Mrp(mrp) => {
            let pointer = format!("{at}/mrp");
            only_three(pointer.clone())?;
            mrp.iter().enumerate().try_for_each(|(i, &x)| {
                ensure(x.abs() <= MOST_MRP, format!("{pointer}/{i}"), || {
                    format!("{x:?} given, the size of a modified Rodrigues parameter is at most {MOST_MRP:e}")
                })
            })?;
        }
    }
    Ok(())
}

/// Checks angles that are given either in radians or in degrees.
fn angles<const N: usize>(pointer: &str, name: &str, given: [Option<[f64; N]>; 2]) -> Check {
    let [rad, deg] = ["rad", "deg"].map(|unit| format!("{pointer}/{name}_{unit}"));
    let (at, angles, most, unit) = match given {
        [Some(angles), None] => (rad, angles, MOST_ANGLE_RAD, "rad"),
        [None, Some(angles)] => (deg, angles, MOST_ANGLE_DEG, "degrees"),
        [None, None] => {
            let message = format!("missing field `{name}_rad` (or `{name}_deg`)");
            return Err(ScenarioError::invalid(pointer, message));
        }
        [Some(_), Some(_)] => {
            let message = format!("is given together with `{name}_rad`; give one of the two");
            return Err(ScenarioError::invalid(deg, message));
        }
    };
    angles.iter().enumerate().try_for_each(|(i, angle)| {
        let at = if N == 1 { at.clone() } else { format!("{at}/{i}") };
        ensure(angle.abs() <= most, at, || {
            format!("{angle:?} given, an angle is at most {most:e} {unit}")
        })
    })
}

/// Checks the inertia at `at`.
pub(super) fn inertia(at: &str, given: &Inertia) -> Check {
    const RANGE: (f64, f64) = (1e-12, 1e12);
    const SCALE: &str = "divide all moments, momenta, torques and strengths by one number: the motion stays the same";
    let moment = |pointer: String, x: f64| {
        ensure(x >= RANGE.0 && x <= RANGE.1, pointer, || {
            let scale = if x > 0.0 { format!("; {SCALE}") } else { String::new() };
            format!(
                "{x:?} given, a moment of inertia must be from {:e} to {:e} kg m^2{scale}",
                RANGE.0, RANGE.1
            )
        })
    };
    match given {
        Inertia::Principal(moments) => moments
            .iter()
            .enumerate()
            .try_for_each(|(i, &x)| moment(format!("{at}/principal/{i}"), x)),
        Inertia::Matrix(rows) => {
            let pointer = format!("{at}/matrix");
            matrix(&pointer, rows, 3)?;
            symmetry(&pointer, rows, 1.0, "symmetric")?;
            // Whether it is positive is seen by its eigenvalues.
            let large = (0..3).find(|&i| rows[i][i] > RANGE.1);
            large.map_or(Ok(()), |i| moment(format!("{pointer}/{i}/{i}"), rows[i][i]))
        }
        Inertia::SecondMoments(moments) => {
            let pointer = format!("{at}/second_moments");
            let n = moments.len();
            ensure((2..=MAX_DIMENSION).contains(&n) || n == LARGE_DIMENSION, &pointer, || {
                format!(
                    "{n} moments given, n must be from 2 to {MAX_DIMENSION}, or {LARGE_DIMENSION}"
                )
            })?;
            vector(&pointer, moments, n)?;
            for j in 0..n {
                for i in 0..j {
                    let sum = moments[i] + moments[j];
                    ensure(sum >= RANGE.0 && sum <= RANGE.1, format!("{pointer}/{j}"), || {
                        format!(
                            "d_{i} + d_{j} = {sum:e}; the sum of any two must be from {:e} to {:e}; {SCALE}",
                            RANGE.0, RANGE.1
                        )
                    })?;
                }
            }
            Ok(())
        }
    }
}

/// Checks a limit: above zero, or not below it.
pub(super) fn limit(pointer: &str, given: Option<f64>, or_zero: bool) -> Check {
    let Some(x) = given else { return Ok(()) };
    strength(pointer, x)?;
    ensure(x > 0.0 || or_zero && x == 0.0, pointer, || {
        format!("{x:?} given, it must be {} 0", if or_zero { "at least" } else { "above" })
    })
}

pub(super) fn only_three(pointer: &str, n: usize) -> Check {
    ensure(n == 3, pointer, || format!("is for n = 3, this body has n = {n}"))
}
