//! The residuals of a fit over time.

use super::plot::{Axis, Line, Scale, Style};
use super::{ChartError, over_time};
use crate::fit::Fit;

/// Draws the residuals of the attitudes, before and after a fit.
///
/// # Errors
/// If the picture cannot be drawn.
pub fn residuals(name: &str, found: &Fit) -> Result<String, ChartError> {
    let axis = Axis { label: "residual of the attitude in rad", scale: Scale::Log };
    let mut chart =
        over_time(&format!("{name}: fitted to {} attitudes", found.residuals.len()), axis);
    for (k, label) in ["before", "after"].into_iter().enumerate() {
        let points = found.residuals.iter().map(|row| (row[0], row[k + 1])).collect();
        let style = Style { color: k, shade: 0, member: k, marked: true };
        chart.lines.push(Line { label: label.to_owned(), points, style });
    }
    chart.draw()
}
