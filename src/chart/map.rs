//! The map of where methods fail: steps across, methods down, the energy error as a colour, what failed as a
//! hatch.
//!
//! Invariant: what a cell says can be read without its colour: a hatch is a class, and classes are named below.

use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::plot::fitted;
use super::{Area, ChartError, Drawn, INK};
use crate::solve::failure::FailureCode as Code;
use crate::study::stability::{Class, Map};

const CELL: (i32, i32) = (26, 20);
const LEFT: i32 = 230;
const TOP: i32 = 64;
const RIGHT: i32 = 30;
/// Letters of a label that fit to the left of the map, and of a title.
const LETTERS: (usize, usize) = (28, 80);
/// The bar of the colours, below the map.
const BAR: (i32, i32) = (320, 14);
/// Places next to each other in the legend, and the width of one.
const LEGEND: (i32, i32) = (3, 290);
/// Energy errors, in parts of the energy that moves, at the two ends of the colours, as powers of ten.
const DECADES: (f64, f64) = (-16.0, 0.0);
/// Cividis (Nunez, Anderton, Renslow 2018) from its bright end, read by eye at five places: even in lightness,
/// so that it can also be read in grey and to the colour-blind.
const CIVIDIS: [(f64, f64, f64); 5] = [
    (254.0, 232.0, 56.0),
    (187.0, 173.0, 108.0),
    (124.0, 123.0, 120.0),
    (65.0, 77.0, 107.0),
    (0.0, 34.0, 78.0),
];
const GREY: RGBColor = RGBColor(226, 226, 226);

/// Draws the map as SVG.
///
/// # Errors
/// If the drawing fails, which no finite data makes it do.
pub fn stability_map(name: &str, map: &Map) -> Result<String, ChartError> {
    let mut svg = String::new();
    draw(&mut svg, name, map).map_err(|error| ChartError::Draw(error.to_string()))?;
    Ok(svg)
}

fn draw(svg: &mut String, name: &str, map: &Map) -> Drawn {
    let classes = classes(map);
    let (columns, rows) = (map.steps_s.len() as i32, map.cells.len() as i32);
    let bottom = TOP + rows * CELL.1;
    let resonates = map.borders.iter().any(|border| !border.resonances.is_empty());
    // Places of the legend before those of the classes: the words about resonances are long.
    let before = if resonates { LEGEND.0 } else { 1 };
    let legend = bottom + 92;
    let legend_rows = (before + classes.len() as i32 + LEGEND.0 - 1) / LEGEND.0;
    let width = (LEFT + columns * CELL.0).max(20 + LEGEND.0 * LEGEND.1) + RIGHT;
    let size = (width, legend + 26 * legend_rows + 14);
    let root = SVGBackend::with_string(svg, (size.0 as u32, size.1 as u32)).into_drawing_area();
    root.fill(&WHITE)?;
    let text = |text: String, at: (i32, i32), size: i32, h: HPos, v: VPos| {
        let font = ("sans-serif", size).into_font().color(&INK).pos(Pos::new(h, v));
        root.draw(&Text::new(text, at, font))
    };
    let title = format!("{name}: where each method is usable");
    text(fitted(&title, LETTERS.1), (20, 14), 19, HPos::Left, VPos::Top)?;
    for (row, (cells, border)) in map.cells.iter().zip(&map.borders).enumerate() {
        let y = TOP + row as i32 * CELL.1;
        let label = fitted(&border.label, LETTERS.0);
        text(label, (LEFT - 10, y + CELL.1 / 2), 14, HPos::Right, VPos::Center)?;
        for (column, cell) in cells.iter().enumerate() {
            let corner = (LEFT + column as i32 * CELL.0, y);
            draw_cell(&root, corner, cell.class, color(map, cell.row.energy_error))?;
        }
        for resonance in &border.resonances {
            let [from, to] = resonance.window_s.map(|step_s| LEFT + column_of(map, step_s));
            draw_window(&root, (from.min(to - 3), to, y + CELL.1))?;
        }
        if let Some(step_s) = border.usable_step_s {
            let x = LEFT + column_of(map, step_s);
            let line = [(x, y + 1), (x, y + CELL.1 - 1)];
            root.draw(&PathElement::new(line, RGBColor(213, 94, 0).stroke_width(4)))?;
        }
    }
    // The axes: steps below, turns above.
    for (column, step_s) in map.steps_s.iter().enumerate().step_by(4) {
        let x = LEFT + column as i32 * CELL.0 + CELL.0 / 2;
        root.draw(&PathElement::new([(x, bottom), (x, bottom + 5)], INK))?;
        text(short(*step_s), (x, bottom + 8), 14, HPos::Center, VPos::Top)?;
        root.draw(&PathElement::new([(x, TOP - 5), (x, TOP)], INK))?;
        let turn = short(step_s * map.fastest_rad_s);
        text(turn, (x, TOP - 8), 14, HPos::Center, VPos::Bottom)?;
    }
    // Left of half a label of the first step.
    let axis = LEFT - 16;
    text("step in s".to_owned(), (axis, bottom + 8), 14, HPos::Right, VPos::Top)?;
    text("turn in rad".to_owned(), (axis, TOP - 8), 14, HPos::Right, VPos::Bottom)?;
    color_bar(&root, (LEFT, bottom + 40), &text)?;
    let line = [(24, legend + 2), (24, legend + 18)];
    root.draw(&PathElement::new(line, RGBColor(213, 94, 0).stroke_width(4)))?;
    let border = "largest usable step, to 5 %".to_owned();
    text(border, (60, legend + 10), 14, HPos::Left, VPos::Center)?;
    if resonates {
        draw_window(&root, (310, 330, legend + 19))?;
        let words = "step resonance: energy is lost in this window";
        text(words.to_owned(), (346, legend + 10), 14, HPos::Left, VPos::Center)?;
    }
    for (at, &class) in classes.iter().enumerate() {
        let place = at as i32 + before;
        let corner = (20 + (place % LEGEND.0) * LEGEND.1, legend + (place / LEGEND.0) * 26);
        draw_cell(&root, corner, class, CIVIDIS_MIDDLE)?;
        let label = (corner.0 + 36, corner.1 + CELL.1 / 2);
        text(words(class), label, 14, HPos::Left, VPos::Center)?;
    }
    root.present()?;
    Ok(())
}

/// Draws a window of steps that a method must not take: a wedge on the lower edge of its row.
fn draw_window(root: &Area<'_>, (from, to, below): (i32, i32, i32)) -> Drawn {
    let middle = (from + to) / 2;
    let wedge = vec![(middle - 5, below - 1), (middle + 5, below - 1), (middle, below - 11)];
    root.draw(&Polygon::new(wedge, RGBColor(213, 94, 0).filled()))?;
    let edge = [(from, below - 2), (to, below - 2)];
    root.draw(&PathElement::new(edge, RGBColor(213, 94, 0).stroke_width(3)))?;
    Ok(())
}

const CIVIDIS_MIDDLE: RGBColor = RGBColor(124, 123, 120);

/// Returns the classes that the map shows in addition to `stable`, each once.
fn classes(map: &Map) -> Vec<Class> {
    let mut classes = Vec::new();
    for class in map.cells.iter().flatten().map(|cell| cell.class) {
        if class != Class::Stable && !classes.contains(&class) {
            classes.push(class);
        }
    }
    classes.sort_by_key(|class| class.as_str());
    classes
}

fn words(class: Class) -> String {
    match class {
        Class::Failed(code) => format!("failed: {code}"),
        Class::EnergyDrifts => "energy drifts".to_owned(),
        Class::BlewUp => "blew up".to_owned(),
        Class::LeftGroup => "left the group".to_owned(),
        Class::WrongBranch => "wrong branch".to_owned(),
        Class::Stable => "stable".to_owned(),
    }
}

/// Returns the place of a step on the axis, in pixels from the left.
fn column_of(map: &Map, step_s: f64) -> i32 {
    let (first, last) = (map.steps_s[0], map.steps_s[map.steps_s.len() - 1]);
    // A map of one step has one column.
    let ratio = libm::log(last / first).max(f64::MIN_POSITIVE);
    let columns = (map.steps_s.len() - 1) as f64 * libm::log(step_s / first) / ratio;
    ((columns + 0.5) * f64::from(CELL.0)) as i32
}

fn color(map: &Map, energy_error: Option<f64>) -> RGBColor {
    let (low, high) = DECADES;
    let error = energy_error.unwrap_or_default() / map.energy_scale.max(f64::MIN_POSITIVE);
    let decade = libm::log10(error.max(f64::MIN_POSITIVE)).clamp(low, high);
    shade((decade - low) / (high - low))
}

/// Returns the colour at a place from 0, bright, to 1, dark.
pub(super) fn shade(place: f64) -> RGBColor {
    let scaled = place * (CIVIDIS.len() - 1) as f64;
    let index = (scaled as usize).min(CIVIDIS.len() - 2);
    let part = scaled - index as f64;
    let (a, b) = (CIVIDIS[index], CIVIDIS[index + 1]);
    let mix = |a: f64, b: f64| (a + part * (b - a)).round() as u8;
    RGBColor(mix(a.0, b.0), mix(a.1, b.1), mix(a.2, b.2))
}

fn color_bar(
    root: &Area<'_>,
    (x, y): (i32, i32),
    text: &impl Fn(
        String,
        (i32, i32),
        i32,
        HPos,
        VPos,
    ) -> Result<(), DrawingAreaErrorKind<std::io::Error>>,
) -> Drawn {
    let (low, high) = DECADES;
    for line in 0..BAR.0 {
        let place = f64::from(line) / f64::from(BAR.0);
        let column = [(x + line, y), (x + line + 1, y + BAR.1)];
        root.draw(&Rectangle::new(column, shade(place).filled()))?;
    }
    for part in 0..=4 {
        let at = x + BAR.0 * part / 4;
        let decade = low + (high - low) * f64::from(part) / 4.0;
        text(format!("1e{decade}"), (at, y + BAR.1 + 6), 14, HPos::Center, VPos::Top)?;
    }
    let words = "energy error / kinetic energy".to_owned();
    text(words, (x - 16, y + BAR.1 / 2), 14, HPos::Right, VPos::Center)?;
    Ok(())
}

/// Draws a cell: its colour where it is usable, else grey with the hatch of its class.
fn draw_cell(root: &Area<'_>, (x, y): (i32, i32), class: Class, color: RGBColor) -> Drawn {
    let (w, h) = (CELL.0 - 1, CELL.1 - 1);
    let fill = if class.is_usable() { color } else { GREY };
    root.draw(&Rectangle::new([(x, y), (x + w, y + h)], fill.filled()))?;
    let line = |from: (i32, i32), to: (i32, i32)| {
        let points = [(x + from.0, y + from.1), (x + to.0, y + to.1)];
        root.draw(&PathElement::new(points, INK))
    };
    let rising = |every: i32| {
        (0..w + h)
            .step_by(every as usize)
            .try_for_each(|d| line((d.min(w), d - d.min(w)), (d - d.min(h), d.min(h))))
    };
    let falling = |every: i32| {
        (0..w + h)
            .step_by(every as usize)
            .try_for_each(|d| line((w - d.min(w), d - d.min(w)), (w - (d - d.min(h)), d.min(h))))
    };
    let flat =
        |every: usize| (every as i32 / 2..h).step_by(every).try_for_each(|d| line((0, d), (w, d)));
    let upright =
        |every: usize| (every as i32 / 2..w).step_by(every).try_for_each(|d| line((d, 0), (d, h)));
    match class {
        Class::Stable => {}
        Class::EnergyDrifts => {
            // A ramp, as the energy would show it.
            let ramp = vec![(x, y + h), (x + w, y + h), (x + w, y + h / 2)];
            root.draw(&Polygon::new(ramp, WHITE.filled()))?;
            line((0, h), (w, h / 2))?;
        }
        Class::WrongBranch => {
            let thick = INK.stroke_width(3);
            root.draw(&PathElement::new([(x + 5, y + 3), (x + w - 5, y + h - 3)], thick))?;
            root.draw(&PathElement::new([(x + 5, y + h - 3), (x + w - 5, y + 3)], thick))?;
        }
        Class::LeftGroup => {
            root.draw(&Circle::new((x + w / 2, y + h / 2), 6, INK.stroke_width(2)))?;
        }
        Class::BlewUp => {
            root.draw(&Rectangle::new([(x, y), (x + w, y + h)], INK.filled()))?;
        }
        Class::Failed(code) => match code {
            Code::MaxIterations => rising(6)?,
            Code::Diverged => falling(6)?,
            Code::Stalled => flat(5)?,
            Code::SecondRoot => {
                rising(6)?;
                flat(6)?;
            }
            Code::LeftGlPlus => upright(5)?,
            Code::IllConditioned => {
                flat(6)?;
                upright(6)?;
            }
            Code::BranchJump => {
                rising(8)?;
                falling(8)?;
            }
            Code::LyapunovSingular => upright(10)?,
            Code::PotentialSingularity => flat(10)?,
            Code::OutsideTable => flat(14)?,
            Code::OpenOrbit => upright(14)?,
            // A study that was stopped has no map.
            Code::Stopped => {}
            Code::NonFinite => {
                let dots = [(6, 5), (13, 5), (19, 5), (6, 13), (13, 13), (19, 13)];
                for (dx, dy) in dots {
                    root.draw(&Circle::new((x + dx, y + dy), 1, INK.filled()))?;
                }
            }
        },
    }
    Ok(())
}

/// Formats a number in two digits, as short as possible.
fn short(x: f64) -> String {
    let digits = libm::log10(x).floor() as i32 - 1;
    let unit = libm::pow(10.0, f64::from(digits));
    let rounded = (x / unit).round();
    format!("{rounded}e{digits}").parse::<f64>().map_or_else(
        |_| String::new(),
        |x| {
            if x < 1e-3 { format!("{x:e}") } else { x.to_string() }
        },
    )
}
