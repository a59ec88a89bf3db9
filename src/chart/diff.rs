//! Chart of the differences of two logs.

use super::plot::{Axis, Line, Scale, Style};
use super::{ChartError, over_time};
use crate::diff::{Comparison, Quantity};

/// Draws the differences of two logs over time, one line per quantity; `names` names the logs.
///
/// # Errors
/// If the drawing fails, which no finite data makes it do.
pub fn differences(names: &str, found: &Comparison) -> Result<String, ChartError> {
    let axis = Axis { label: "difference, in the unit next to each name", scale: Scale::Log };
    let mut chart = over_time(&format!("Differences of {names}"), axis);
    for (k, quantity) in Quantity::ALL.into_iter().enumerate() {
        let points = found.over_time.iter().filter_map(|row| Some((row.time_s, row.by[k]?)));
        let mut points: Vec<_> = points.collect();
        // No difference, as at the start, has no place on this axis; if there is none at all, that is shown.
        if points.iter().any(|&(_, by)| by > 0.0) {
            points.retain(|&(_, by)| by > 0.0);
        }
        if !points.is_empty() {
            let label = format!("{} in {}", quantity.name(), quantity.unit());
            let style = Style { color: k, shade: 0, member: k, marked: false };
            chart.lines.push(Line { label, points, style });
        }
    }
    chart.draw()
}
