//! The page of a report: tables, histograms, and how the means settle.

use std::fmt::Write as _;

use super::ChartError;
use super::plot::{Axis, Line, Plot, Scale, Style};
use crate::sweep::statistics::Figure;
use crate::sweep::{Column, Report};

/// Draws a report as one HTML page that needs nothing else.
///
/// # Errors
/// If a picture cannot be drawn.
pub fn report(found: &Report) -> Result<String, ChartError> {
    let mut page = String::from(
        "<!doctype html><html lang=\"en\"><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width\">",
    );
    let name = escaped(&found.name);
    let counts = found.counts;
    let _ = write!(
        page,
        "<title>{name}</title><style>body{{font:16px sans-serif;max-width:60em;margin:1em auto;padding:0 1em}}\
         svg{{max-width:100%;height:auto}}table{{border-collapse:collapse}}td,th{{padding:.2em .8em;text-align:left;border-bottom:1px solid #ccc}}</style>\
         <h1>{name}</h1><p>{} members succeeded, {} failed, {} were refused, {} have no line yet. Intervals hold with {} %.</p>",
        counts.succeeded,
        counts.failed,
        counts.refused,
        found.missing,
        100.0 * found.confidence
    );
    if !found.probabilities.is_empty() {
        page += "<h2>Probabilities</h2><table>";
        for one in &found.probabilities {
            let sign = if one.holds.below { "&lt;" } else { "&gt;" };
            let _ = write!(
                page,
                "<tr><td>{} {sign} {}</td><td>{}</td></tr>",
                escaped(&one.holds.column),
                one.holds.limit,
                figure(&one.part)
            );
        }
        page += "</table>";
    }
    for column in &found.columns {
        let _ = write!(
            page,
            "<h2>{}</h2><table><tr><td>mean</td><td>{:.4e} &plusmn; {:.1e}</td></tr>",
            escaped(&column.name),
            column.mean,
            column.standard_error
        );
        for (part, quantile) in &column.quantiles {
            let _ =
                write!(page, "<tr><td>{} %</td><td>{}</td></tr>", 100.0 * part, figure(quantile));
        }
        for (field, correlation) in &column.rank_correlations {
            let _ = write!(
                page,
                "<tr><td>rank correlation with {}</td><td>{}</td></tr>",
                escaped(field),
                figure(correlation)
            );
        }
        for (field, sobol) in &column.sobol {
            let _ = write!(
                page,
                "<tr><td>index of {}</td><td>first {}, total {}</td></tr>",
                escaped(field),
                figure(&sobol.first),
                figure(&sobol.total)
            );
        }
        page += "</table>";
        page += &histogram(column)?;
        page += &convergence(column)?;
    }
    page += "</html>\n";
    Ok(page)
}

fn histogram(column: &Column) -> Result<String, ChartError> {
    let shown = &column.histogram;
    let width = (shown.to - shown.from) / shown.counts.len() as f64;
    let mut points = vec![(shown.from, 0.0)];
    for (k, &count) in shown.counts.iter().enumerate() {
        let edge = |k: usize| shown.from + k as f64 * width;
        points.extend([(edge(k), count as f64), (edge(k + 1), count as f64)]);
    }
    points.push((shown.to, 0.0));
    drawn(&format!("{}: how often", column.name), (&column.name, "members"), points, Scale::Linear)
}

fn convergence(column: &Column) -> Result<String, ChartError> {
    let points = column.convergence.iter().map(|&(count, _, error)| (count as f64, error));
    let title = format!("{}: how the mean settles", column.name);
    drawn(&title, ("members", "standard error of the mean"), points.collect(), Scale::Log)
}

fn drawn(
    title: &str,
    (x, y): (&str, &'static str),
    points: Vec<(f64, f64)>,
    scale: Scale,
) -> Result<String, ChartError> {
    let style = Style { color: 0, shade: 0, member: 0, marked: scale == Scale::Log };
    let line = Line { label: x.to_owned(), points, style };
    let x = Axis { label: if scale == Scale::Log { "members" } else { "value" }, scale };
    Plot {
        title: title.to_owned(),
        x,
        y: Axis { label: y, scale },
        lines: vec![line],
        points: Vec::new(),
        rings: Vec::new(),
        guides: Vec::new(),
        guide_label: String::new(),
    }
    .draw()
}

fn figure(found: &Figure) -> String {
    let end = |end: Option<f64>| end.map_or_else(|| "open".to_owned(), |x| format!("{x:.3e}"));
    format!("{:.4e} ({} to {})", found.value, end(found.low), end(found.high))
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}
