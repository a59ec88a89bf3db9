//! Checks of a solved step that all implicit schemes share.

use crate::failure::{Failure, FailureCode};
use crate::nonlinear::Convergence;
use crate::so::{self, Mat};

/// Smallest singular value of an interpolated matrix for which its polar factor is accepted.
pub(super) const SMALLEST_SINGULAR_VALUE: f64 = 0.1;

/// Largest distance, as `|g - h|_F / sqrt(2)`, between the end of a step and that of two of half
/// its length. On random scenes at the largest steps that are solved, the right solutions of two to
/// four stages end by at most 0.4 from there, and those of the second roots that Newton's method
/// has found by 0.5 to 1.4; one stage errs by 0.9 by itself.
const FAR: [f64; 2] = [1.0, 0.5];

/// Refuses a spurious root of Newton's method: two half steps by fixed-point iteration, which follow the branch
/// continuous in h, end elsewhere. `half` makes one of these, from the start of the step, and gives the
/// attitude; `end` is the attitude that the step of a scheme of this order reached.
///
/// # Errors
/// [`FailureCode::SecondRoot`] with the distance.
pub(super) fn check_root<const N: usize>(
    solved: Convergence,
    order: u32,
    end: &Mat<N>,
    mut half: impl FnMut() -> Result<Option<Mat<N>>, Failure>,
) -> Result<(), Failure> {
    let mut reached = None;
    for _ in 0..2 {
        match half() {
            Ok(attitude) => reached = attitude,
            Err(stopped) if stopped.code == FailureCode::Stopped => return Err(stopped),
            // If these are not solved either, there is nothing to compare with.
            Err(_) => return Ok(()),
        }
    }
    let Some(reached) = reached else { return Ok(()) };
    let far = FAR[usize::from(order > 2)];
    let apart = reached - end;
    let distance = so::inner(&apart, &apart).sqrt();
    if distance <= far {
        Ok(())
    } else {
        Err(Failure {
            iterations: solved.iterations,
            ..Failure::new(FailureCode::SecondRoot, None, distance, far)
        })
    }
}

/// Refuses a matrix that is nearly singular, or reflects: by its smallest singular value, less than zero if it reflects.
pub(crate) fn check_singular_value(sigma: f64, stage: Option<usize>) -> Result<(), Failure> {
    if sigma >= SMALLEST_SINGULAR_VALUE {
        return Ok(());
    }
    let code = if sigma > 0.0 { FailureCode::IllConditioned } else { FailureCode::LeftGlPlus };
    Err(Failure::new(code, stage, sigma, SMALLEST_SINGULAR_VALUE))
}

/// Refuses a turn of a quarter or more from one node to the next, by its trace or cosine and that of a quarter turn: it may
/// be of another branch of the polar factor.
pub(super) fn check_branch(found: f64, limit: f64, stage: Option<usize>) -> Result<(), Failure> {
    if found > limit {
        return Ok(());
    }
    Err(Failure::new(FailureCode::BranchJump, stage, found, limit))
}

/// Refuses a solution that jumps between two nodes, from `start` on: a determinant cannot show a turn past half a circle. `trace` is
/// that of the rotation between two attitudes, or its cosine, `limit` its value for a quarter turn; each attitude comes with
/// its stage, `None` for the end.
pub(crate) fn check_continuity<U>(
    start: U,
    nodes: impl IntoIterator<Item = (Option<usize>, U)>,
    limit: f64,
    trace: impl Fn(&U, &U) -> f64,
) -> Result<(), Failure> {
    let mut before = start;
    for (stage, attitude) in nodes {
        check_branch(trace(&before, &attitude), limit, stage)?;
        before = attitude;
    }
    Ok(())
}
