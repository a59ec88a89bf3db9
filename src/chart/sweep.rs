//! The picture of a sweep: a map over two fields, or points over one.
//!
//! Invariant: what has no value is no colour of the scale: a hatch says why.

use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::map::shade;
use super::plot::{Axis, Plot, Scale, fitted, number};
use super::{Area, ChartError, Drawn, INK, PALE};
use crate::sweep::{Cell, Kind, Shown, Side};

const LEFT: i32 = 110;
const TOP: i32 = 64;
/// Approximate size of the map in pixels.
const MAP: (i32, i32) = (640, 480);
const RIGHT: i32 = 190;
const BELOW: i32 = 90;
const BAR: i32 = 240;
/// Least width of the picture: that of a title.
const WIDTH: i32 = 640;
/// Letters of a value at an axis, at most: what fits left of the map.
const LETTERS: usize = 12;

/// Draws the picture as SVG.
///
/// # Errors
/// If the drawing fails, which no finite data makes it do.
pub(crate) fn sweep(shown: &Shown) -> Result<String, ChartError> {
    match &shown.kind {
        Kind::Points { x, points } => self::points(shown, x, points),
        Kind::Map { x, y, cells } => {
            let mut svg = String::new();
            map(&mut svg, shown, (x, y), cells)
                .map_err(|error| ChartError::Draw(error.to_string()))?;
            // Scaled by a viewer, cells would show seams between them.
            Ok(svg.replacen("<svg ", "<svg shape-rendering=\"crispEdges\" ", 1))
        }
    }
}

/// Returns a logarithmic scale for values of one sign over some decades, else a linear one.
fn scale(values: &[f64]) -> Scale {
    let (low, high) = ends(values);
    if low > 0.0 && high > 1e3 * low { Scale::Log } else { Scale::Linear }
}

fn ends(values: &[f64]) -> (f64, f64) {
    let ends = (f64::INFINITY, f64::NEG_INFINITY);
    values.iter().fold(ends, |(low, high), &x| (low.min(x), high.max(x)))
}

fn title(shown: &Shown) -> String {
    let Shown { name, column, without, .. } = shown;
    match without {
        0 => format!("{name}: {column}"),
        without => format!("{name}: {column} ({without} members have none)"),
    }
}

fn points(shown: &Shown, x: &str, points: &[(f64, f64)]) -> Result<String, ChartError> {
    let of = |pick: fn(&(f64, f64)) -> f64| points.iter().map(pick).collect::<Vec<f64>>();
    let plot = Plot {
        title: title(shown),
        x: Axis { label: x, scale: scale(&of(|point| point.0)) },
        y: Axis { label: &shown.column, scale: scale(&of(|point| point.1)) },
        lines: Vec::new(),
        points: points.to_vec(),
        rings: Vec::new(),
        guides: Vec::new(),
        guide_label: String::new(),
    };
    plot.draw()
}

fn map(svg: &mut String, shown: &Shown, (x, y): (&Side, &Side), cells: &[Cell]) -> Drawn {
    let (columns, rows) = (x.values.len() as i32, y.values.len() as i32);
    let letters = |text: &String| text.chars().count() as i32;
    // A few columns are as wide as what is written below them.
    let apart = 9 * x.values.iter().map(|value| letters(&label(value))).max().unwrap_or(0) + 8;
    let cell = ((MAP.0 / columns).clamp(2, apart.max(60)), (MAP.1 / rows).clamp(2, 60));
    let (right, bottom) = (LEFT + columns * cell.0, TOP + rows * cell.1);
    let x_name = fitted(&x.name, 40);
    // The colour bar, right of the map and of the name below it.
    let bar = right.max(LEFT + 10 * letters(&x_name)) + 24;
    let size = ((bar - 24 + RIGHT).max(WIDTH), (bottom + BELOW).max(TOP + BAR + 24 + 4 * 26 + 14));
    let root = SVGBackend::with_string(svg, (size.0 as u32, size.1 as u32)).into_drawing_area();
    root.fill(&WHITE)?;
    let text = |text: &str, at: (i32, i32), size: i32, h: HPos, v: VPos| {
        let font = ("sans-serif", size).into_font().color(&INK).pos(Pos::new(h, v));
        root.draw(&Text::new(text.to_owned(), at, font))
    };
    text(&fitted(&title(shown), (size.0 - 40) as usize / 12), (20, 14), 19, HPos::Left, VPos::Top)?;
    let values: Vec<f64> = cells
        .iter()
        .filter_map(|cell| match cell {
            Cell::Value(value) => Some(*value),
            _ => None,
        })
        .collect();
    let scale = scale(&values);
    let place = |value: f64| if scale == Scale::Log { libm::log10(value) } else { value };
    let (low, high) = ends(&values);
    let (low, high) = if low <= high { (place(low), place(high)) } else { (0.0, 1.0) };
    let width = (high - low).max(f64::MIN_POSITIVE);
    for (at, &content) in cells.iter().enumerate() {
        let (column, row) = (at as i32 % columns, at as i32 / columns);
        // The first value of y stands at the bottom.
        let corner = (LEFT + column * cell.0, bottom - (row + 1) * cell.1);
        // Dark is small, bright is large.
        let color = match content {
            Cell::Value(value) => Some(shade(1.0 - (place(value) - low) / width)),
            _ => None,
        };
        draw_cell(&root, corner, cell, content, color)?;
    }
    let outline = [(LEFT, TOP), (right, bottom)];
    root.draw(&Rectangle::new(outline, INK))?;
    for (at, value) in ticks(&x.values, cell.0, apart) {
        let middle = LEFT + at as i32 * cell.0 + cell.0 / 2;
        root.draw(&PathElement::new([(middle, bottom), (middle, bottom + 5)], INK))?;
        text(&label(value), (middle, bottom + 8), 14, HPos::Center, VPos::Top)?;
    }
    for (at, value) in ticks(&y.values, cell.1, 30) {
        let middle = bottom - at as i32 * cell.1 - cell.1 / 2;
        root.draw(&PathElement::new([(LEFT - 5, middle), (LEFT, middle)], INK))?;
        text(&label(value), (LEFT - 8, middle), 14, HPos::Right, VPos::Center)?;
    }
    text(&x_name, (LEFT, bottom + 34), 16, HPos::Left, VPos::Top)?;
    text(&fitted(&y.name, 40), (20, TOP - 10), 16, HPos::Left, VPos::Bottom)?;
    color_bar(&root, bar, (low, high), scale, &text)?;
    legend(&root, bar, cells, &text)?;
    root.present()?;
    Ok(())
}

/// Returns a value as a label of an axis: a number in four digits, anything else in as many letters as fit.
fn label(value: &str) -> String {
    match value.parse::<f64>() {
        Ok(x) if value.len() > 8 => {
            let rounded = format!("{x:.3e}").parse::<f64>().unwrap_or(x);
            let plain = rounded == 0.0 || (1e-3..1e5).contains(&rounded.abs());
            if plain { rounded.to_string() } else { format!("{rounded:e}") }
        }
        _ => fitted(value, LETTERS),
    }
}

/// Returns the values that get a label, with `apart` pixels between them.
fn ticks(values: &[String], cell: i32, apart: i32) -> impl Iterator<Item = (usize, &String)> {
    values.iter().enumerate().step_by((apart as usize).div_ceil(cell as usize).max(1))
}

type Texts<'a> = &'a dyn Fn(
    &str,
    (i32, i32),
    i32,
    HPos,
    VPos,
) -> Result<(), DrawingAreaErrorKind<std::io::Error>>;

fn color_bar(
    root: &Area<'_>,
    x: i32,
    (low, high): (f64, f64),
    scale: Scale,
    text: Texts<'_>,
) -> Drawn {
    for line in 0..BAR {
        let row = [(x, TOP + line), (x + 18, TOP + line + 1)];
        root.draw(&Rectangle::new(row, shade(f64::from(line) / f64::from(BAR)).filled()))?;
    }
    let (step, largest) = ((high - low) / 4.0, high.abs().max(low.abs()));
    // Values that are all the same are one number, in the middle.
    let parts = if step > 1e-12 * largest { 0..=4 } else { 2..=2 };
    for part in parts {
        let value = high - step * f64::from(part);
        let word = match scale {
            Scale::Log => format!("{:.1e}", libm::pow(10.0, value)),
            // A digit more than the steps differ in, which need not be round.
            Scale::Linear => number(value, 0.1 * step.max(1e-12 * largest), largest),
        };
        text(&word, (x + 26, TOP + BAR * part / 4), 14, HPos::Left, VPos::Center)?;
    }
    Ok(())
}

/// Draws the legend of the hatches that occur.
fn legend(root: &Area<'_>, x: i32, cells: &[Cell], text: Texts<'_>) -> Drawn {
    let kinds = [
        (Cell::Failed, "failed"),
        (Cell::Refused, "refused"),
        (Cell::Empty, "no value"),
        (Cell::Waiting, "not run yet"),
    ];
    let there = kinds.into_iter().filter(|(kind, _)| cells.contains(kind));
    for (at, (kind, word)) in there.enumerate() {
        let y = TOP + BAR + 24 + 26 * at as i32;
        draw_cell(root, (x, y), (26, 18), kind, None)?;
        text(word, (x + 36, y + 9), 14, HPos::Left, VPos::Center)?;
    }
    Ok(())
}

/// Draws a cell of a size in pixels: its colour if it has a value, else a hatch.
fn draw_cell(
    root: &Area<'_>,
    (x, y): (i32, i32),
    (w, h): (i32, i32),
    content: Cell,
    color: Option<RGBColor>,
) -> Drawn {
    let fill = match content {
        Cell::Waiting => WHITE,
        _ => color.unwrap_or(PALE),
    };
    root.draw(&Rectangle::new([(x, y), (x + w, y + h)], fill.filled()))?;
    let line = |from: (i32, i32), to: (i32, i32)| {
        root.draw(&PathElement::new([(x + from.0, y + from.1), (x + to.0, y + to.1)], INK))
    };
    match content {
        Cell::Failed => {
            line((0, h), (w, 0))?;
            line((0, 0), (w, h))?;
        }
        Cell::Refused => line((0, h / 2), (w, h / 2))?,
        Cell::Empty => line((0, h), (w, 0))?,
        Cell::Waiting | Cell::Value(_) => {}
    }
    Ok(())
}
