//! Lines on two axes, each linear or logarithmic.
//!
//! Invariant: nothing is drawn over the data: title above, names at the side.

use std::ops::Range;

use plotters::coord::ranged1d::{KeyPointHint, NoDefaultFormatting, ValueFormatter};
use plotters::element::DashedPathElement;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::{Area, ChartError, Drawn, INK, PALE, PALETTE};

/// Division of an axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scale {
    /// Evenly.
    Linear,
    /// By powers of ten; only the size of a value is drawn, zero at the end of the axis.
    Log,
}

/// An axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Axis<'a> {
    /// Quantity that it shows, with its unit.
    pub label: &'a str,
    /// Division of the axis.
    pub scale: Scale,
}

/// The look of a line: its colour shows the family of the method; its lightness, dash and marker the member.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Style {
    /// Number of the colour.
    pub color: usize,
    /// Number of its lightness; 0 is the colour itself.
    pub shade: usize,
    /// Number of the member in its family.
    pub member: usize,
    /// Whether each point is marked.
    pub marked: bool,
}

/// A line of a chart.
#[derive(Clone, Debug, PartialEq)]
pub struct Line {
    /// Label for the legend; not shown for a single line.
    pub label: String,
    /// Its points.
    pub points: Vec<(f64, f64)>,
    /// Its look.
    pub style: Style,
}

/// A chart of lines.
#[derive(Clone, Debug, PartialEq)]
pub struct Plot<'a> {
    /// Title of the chart.
    pub title: String,
    /// Horizontal axis.
    pub x: Axis<'a>,
    /// Vertical axis.
    pub y: Axis<'a>,
    /// The lines.
    pub lines: Vec<Line>,
    /// Points by themselves, behind the lines.
    pub points: Vec<(f64, f64)>,
    /// Points of lines from which an order is read, with a ring around each.
    pub rings: Vec<(f64, f64)>,
    /// Dashed lines in black to compare slopes with: two ends each.
    pub guides: Vec<[(f64, f64); 2]>,
    /// Label of the guides in the legend.
    pub guide_label: String,
}

const SIZE: (u32, u32) = (960, 480);
/// Space for a line of the legend, in pixels.
const LEGEND_ROW: i32 = 22;
/// Letters of a name in the legend, at most.
const LONGEST_NAME: usize = 40;
const TITLE_HEIGHT: u32 = 44;
/// Decades of a logarithmic axis, at most: a tenth of the spacing of numbers as large as the largest. Where all values are
/// zero, they are drawn this far below one.
const DECADES: f64 = 17.0;
/// Largest number of points: the width of the plot in pixels.
const MAX_POINTS: usize = 800;
/// Number of points below which each of them is drawn larger.
const FEW_POINTS: usize = 200;
/// Lengths of dash and gap in pixels; a dash of 0 is a whole line.
const GUIDE: (u32, u32) = (5, 5);
/// One more than there are shades: members look the same only where both lists begin anew.
const DASHES: [(u32, u32); 7] = [(0, 0), (8, 4), (3, 3), (14, 4), (14, 8), (3, 7), (26, 10)];
/// Parts of white, or of black where negative, in the colours of the members of a family: they differ in grey, too.
const SHADES: [f64; 6] = [0.0, -0.45, 0.45, -0.75, 0.25, -0.25];

/// An axis with its range and the places that get a number; in decades if logarithmic.
#[derive(Clone, Debug)]
struct Ruler {
    scale: Scale,
    range: Range<f64>,
    ticks: Vec<f64>,
}

impl Scale {
    /// Returns the place where a value is drawn, in decades on a logarithmic axis: minus infinity for zero.
    fn place(self, value: f64) -> f64 {
        match self {
            Self::Linear => value,
            Self::Log => libm::log10(value.abs()),
        }
    }

    /// Returns an axis on which all places can be drawn.
    fn ruler(self, places: impl Iterator<Item = f64>) -> Ruler {
        let (low, high) = places
            .filter(|place| place.is_finite())
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (low.min(x), high.max(x)));
        let start = if self == Self::Log { -DECADES } else { 0.0 };
        let (low, high) = if low <= high { (low, high) } else { (start, start + 1.0) };
        let (low, high, step) = match self {
            Self::Log => {
                // Whole decades, two at least, so that the axis has a scale.
                let high = (high + 1e-9).ceil();
                let low = low.floor().clamp(high - DECADES, high - 2.0);
                (low, high, ((high - low) / 10.0).ceil())
            }
            Self::Linear => {
                // A range that nearly begins at zero begins there.
                let low = if low > 0.0 && low < 0.05 * high { 0.0 } else { low };
                // Equal values stand in the middle of an axis of their size.
                let alike = high - low <= 1e-12 * high.abs().max(low.abs());
                let half = 0.5 * if high == 0.0 { 1.0 } else { high.abs() };
                let (low, high) = if alike { (low - half, high + half) } else { (low, high) };
                let span = (high - low).clamp(f64::MIN_POSITIVE * 1e20, f64::MAX);
                let decade = libm::pow(10.0, libm::log10(span / 5.0).floor());
                let steps = [1.0, 2.0, 5.0, 10.0].map(|factor| factor * decade);
                let step = steps.into_iter().find(|step| span / step <= 8.0).unwrap_or(span);
                (low, low + span, step)
            }
        };
        let first = (low / step).ceil();
        let count = (high / step - first + 1e-9).floor().max(0.0) as usize;
        let ticks = (0..=count).map(|k| (first + k as f64) * step).collect();
        Ruler { scale: self, range: low..high, ticks }
    }
}

impl Ranged for Ruler {
    type FormatOption = NoDefaultFormatting;
    type ValueType = f64;

    fn map(&self, place: &f64, (from, to): (i32, i32)) -> i32 {
        // Places beyond the axis are drawn at its end.
        let place = place.clamp(self.range.start, self.range.end);
        let part = (place - self.range.start) / (self.range.end - self.range.start);
        from + (f64::from(to - from) * part).round() as i32
    }

    fn key_points<H: KeyPointHint>(&self, hint: H) -> Vec<f64> {
        if hint.weight().allow_light_points() { Vec::new() } else { self.ticks.clone() }
    }

    fn range(&self) -> Range<f64> {
        self.range.clone()
    }
}

impl ValueFormatter<f64> for Ruler {
    fn format_ext(&self, place: &f64) -> String {
        match self.scale {
            Scale::Log => format!("1e{}", place.round()),
            Scale::Linear => {
                let step = match self.ticks.as_slice() {
                    [first, second, ..] => second - first,
                    _ => self.range.end - self.range.start,
                };
                number(*place, step, self.range.start.abs().max(self.range.end.abs()))
            }
        }
    }
}

/// Returns a number of a linear scale with the digits in which it differs from those a step away; `largest` is the largest
/// size of the scale.
pub(super) fn number(place: f64, step: f64, largest: f64) -> String {
    if place.abs() < 1e-6 * step {
        return "0".to_owned();
    }
    let power = |x: f64| libm::log10(x * (1.0 + 1e-9)).floor() as i32;
    let finest = power(step);
    if (1e-3..1e7).contains(&largest) {
        let digits = usize::try_from(-finest).unwrap_or(0);
        return format!("{place:.digits$}");
    }
    let digits = usize::try_from(power(place.abs()) - finest).unwrap_or(0);
    format!("{place:.digits$e}")
}

/// Returns a text of at most `letters` letters: the middle of a longer one is left out, because names differ at their ends.
pub(super) fn fitted(text: &str, letters: usize) -> String {
    let count = text.chars().count();
    if count <= letters {
        return text.to_owned();
    }
    let kept = letters.saturating_sub(1);
    let front: String = text.chars().take(kept.div_ceil(2)).collect();
    let back: String = text.chars().skip(count - kept / 2).collect();
    format!("{front}…{back}")
}

impl Plot<'_> {
    /// Draws the chart as SVG.
    ///
    /// # Errors
    /// If the drawing fails, which no finite data makes it do.
    pub fn draw(&self) -> Result<String, ChartError> {
        let mut svg = String::new();
        self.draw_into(&mut svg).map_err(|error| ChartError::Draw(error.to_string()))?;
        Ok(svg)
    }

    fn draw_into(&self, svg: &mut String) -> Drawn {
        let place = |&(x, y): &(f64, f64)| (self.x.scale.place(x), self.y.scale.place(y));
        let lines: Vec<Vec<(f64, f64)>> = self
            .lines
            .iter()
            .map(|line| envelope(&line.points).iter().map(place).collect())
            .collect();
        let points: Vec<(f64, f64)> = self.points.iter().map(place).collect();
        let all = || lines.iter().flatten().chain(&points);
        let x = self.x.scale.ruler(all().map(|p| p.0));
        let y = self.y.scale.ruler(all().map(|p| p.1));
        // A long legend makes the picture longer, not the chart.
        let height = SIZE.1.max(TITLE_HEIGHT + self.legend_height());
        let root = SVGBackend::with_string(svg, (SIZE.0, height)).into_drawing_area();
        root.fill(&WHITE)?;
        let (head, below) = root.split_vertically(TITLE_HEIGHT);
        let title = ("sans-serif", 19).into_font().color(&INK);
        head.draw(&Text::new(fitted(&self.title, 84), (20, 14), title))?;
        let (body, side) = below.split_horizontally(SIZE.0 - self.legend_width());
        let (body, _) = body.split_vertically(SIZE.1 - TITLE_HEIGHT);
        // Space for the widest number of the vertical axis, next to its name.
        let widest = y.ticks.iter().map(|tick| y.format_ext(tick).chars().count()).max();
        let numbers = (30 + 8 * widest.unwrap_or(0) as u32).max(76);
        let mut chart = ChartBuilder::on(&body)
            .margin(10)
            .margin_right(36)
            .x_label_area_size(48)
            .y_label_area_size(numbers)
            .build_cartesian_2d(x.clone(), y.clone())?;
        chart
            .configure_mesh()
            .light_line_style(TRANSPARENT)
            .bold_line_style(PALE)
            .axis_style(INK)
            .x_desc(fitted(self.x.label, 50))
            .y_desc(fitted(self.y.label, 50))
            .x_label_formatter(&|place| x.format_ext(place))
            .y_label_formatter(&|place| y.format_ext(place))
            .label_style(("sans-serif", 15).into_font().color(&INK))
            .axis_desc_style(("sans-serif", 16).into_font().color(&INK))
            .draw()?;
        // From here on in pixels, so that the legend shows what the chart shows.
        let pixels = |points: &[(f64, f64)]| -> Vec<(i32, i32)> {
            points.iter().map(|point| chart.backend_coord(point)).collect()
        };
        let radius = if points.len() < FEW_POINTS { 4 } else { 2 };
        for pixel in pixels(&points) {
            root.draw(&Circle::new(pixel, radius, PALETTE[0].filled()))?;
        }
        for guide in &self.guides {
            let ends = guide.map(|end| place(&end));
            if let Some(ends) = clipped(ends, &x.range, &y.range) {
                dashed(&root, pixels(&ends), GUIDE, BLACK.stroke_width(1))?;
            }
        }
        for (line, points) in self.lines.iter().zip(&lines) {
            line.style.draw(&root, pixels(points))?;
        }
        let rings: Vec<(f64, f64)> = self.rings.iter().map(place).collect();
        for pixel in pixels(&rings) {
            ring(&root, pixel)?;
        }
        self.legend(&side)?;
        root.present()?;
        Ok(())
    }

    fn has_legend(&self) -> bool {
        self.lines.len() > 1 || !self.guides.is_empty()
    }

    /// Returns the room for the names at the side of the chart, if there is more than one line.
    fn legend_width(&self) -> u32 {
        let labels = self.lines.iter().map(|line| line.label.as_str());
        let rings = if self.rings.is_empty() { "" } else { RINGED };
        let labels = labels.chain([self.guide_label.as_str(), rings]);
        let longest = labels.map(|label| label.chars().count().min(LONGEST_NAME)).max();
        if self.has_legend() { 56 + 8 * longest.unwrap_or(0) as u32 } else { 0 }
    }

    /// Returns the height of the names at the side.
    fn legend_height(&self) -> u32 {
        let rows = self.lines.len() + usize::from(!self.guides.is_empty());
        let rows = rows + usize::from(!self.rings.is_empty());
        if self.has_legend() { 24 + LEGEND_ROW as u32 * rows as u32 } else { 0 }
    }

    fn legend(&self, side: &Area<'_>) -> Drawn {
        if !self.has_legend() {
            return Ok(());
        }
        let font =
            ("sans-serif", 15).into_font().color(&INK).pos(Pos::new(HPos::Left, VPos::Center));
        let mut y = 24;
        for line in &self.lines {
            let name = fitted(&line.label, LONGEST_NAME);
            side.draw(&Text::new(name, (44, y), font.clone()))?;
            line.style.draw(side, vec![(4, y), (36, y)])?;
            y += LEGEND_ROW;
        }
        if !self.guides.is_empty() {
            let name = fitted(&self.guide_label, LONGEST_NAME);
            side.draw(&Text::new(name, (44, y), font.clone()))?;
            dashed(side, vec![(4, y), (36, y)], GUIDE, BLACK.stroke_width(1))?;
            y += LEGEND_ROW;
        }
        if !self.rings.is_empty() {
            side.draw(&Text::new(RINGED, (44, y), font))?;
            ring(side, (20, y))?;
        }
        Ok(())
    }
}

impl Style {
    /// Draws a line through pixels, and a mark at each (for a sample in a legend, in its middle).
    fn draw(self, area: &Area<'_>, pixels: Vec<(i32, i32)>) -> Drawn {
        let color = of_shade(PALETTE[self.color % PALETTE.len()], self.shade);
        let dash = DASHES[self.member % DASHES.len()];
        dashed(area, pixels.clone(), dash, color.stroke_width(2))?;
        if self.marked {
            for pixel in pixels {
                self.mark(area, pixel, color.filled())?;
            }
        }
        Ok(())
    }

    fn mark(self, area: &Area<'_>, (x, y): (i32, i32), style: ShapeStyle) -> Drawn {
        match self.member % 5 {
            0 => area.draw(&Circle::new((x, y), 4, style))?,
            1 => area.draw(&Rectangle::new([(x - 4, y - 4), (x + 4, y + 4)], style))?,
            2 => area.draw(&TriangleMarker::new((x, y), 6, style))?,
            3 => {
                area.draw(&Polygon::new([(x - 6, y), (x, y - 6), (x + 6, y), (x, y + 6)], style))?
            }
            _ => area.draw(&Cross::new(
                (x, y),
                4,
                ShapeStyle { filled: false, stroke_width: 2, ..style },
            ))?,
        }
        Ok(())
    }
}

/// What a ring says, in the legend.
const RINGED: &str = "order read here";

fn ring(area: &Area<'_>, pixel: (i32, i32)) -> Drawn {
    area.draw(&Circle::new(pixel, 8, INK.stroke_width(1)))?;
    Ok(())
}

/// Returns a colour in one of its lightnesses.
pub(super) fn of_shade(RGBColor(r, g, b): RGBColor, shade: usize) -> RGBColor {
    let part = SHADES[shade % SHADES.len()];
    let towards = if part > 0.0 { 255.0 } else { 0.0 };
    let mix = |x: u8| (f64::from(x) + part.abs() * (towards - f64::from(x))).round() as u8;
    RGBColor(mix(r), mix(g), mix(b))
}

fn dashed(
    area: &Area<'_>,
    pixels: Vec<(i32, i32)>,
    (dash, gap): (u32, u32),
    style: ShapeStyle,
) -> Drawn {
    if dash == 0 {
        area.draw(&PathElement::new(pixels, style))?;
    } else {
        area.draw(&DashedPathElement::new(pixels, dash, gap, style))?;
    }
    Ok(())
}

/// Returns the part of a straight line inside a box; `None` if there is none.
fn clipped([a, b]: [(f64, f64); 2], x: &Range<f64>, y: &Range<f64>) -> Option<[(f64, f64); 2]> {
    // Liang and Barsky: the parts of the line inside each of the four edges.
    let (dx, dy) = (b.0 - a.0, b.1 - a.1);
    let (mut from, mut to) = (0.0_f64, 1.0_f64);
    for (change, room) in
        [(-dx, a.0 - x.start), (dx, x.end - a.0), (-dy, a.1 - y.start), (dy, y.end - a.1)]
    {
        let at = room / change;
        if change < 0.0 {
            from = from.max(at);
        } else if change > 0.0 {
            to = to.min(at);
        } else if room < 0.0 {
            return None;
        }
    }
    let point = |t: f64| (a.0 + t * dx, a.1 + t * dy);
    (from < to).then(|| [point(from), point(to)])
}

/// Returns the sizes of a line, the largest in each of at most [`MAX_POINTS`] intervals.
fn envelope(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let width = points.len().div_ceil(MAX_POINTS).max(1);
    points
        .chunks(width)
        .map(|chunk| (chunk[0].0, chunk.iter().map(|&(_, y)| y.abs()).fold(0.0, f64::max)))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::{DASHES, Ranged, SHADES, Scale};

    #[test]
    fn members_of_a_family_differ_in_dash_or_lightness() {
        let looks = (0..40).map(|member| (DASHES[member % DASHES.len()], member % SHADES.len()));
        let looks: Vec<_> = looks.collect();
        for (member, look) in looks.iter().enumerate() {
            assert!(!looks[..member].contains(look), "{member}: {look:?}");
        }
    }

    #[test]
    fn a_logarithmic_axis_shows_the_smallest_size_and_zero_at_its_end() {
        // Errors of a small body, of a large one, and none at all.
        for (sizes, range, visible) in [
            ([0.0, 3e-22, 2e-20], -22.0..-19.0, true),
            ([0.0, 3e3, 2e5], 3.0..6.0, true),
            ([0.0, 3e-30, 2e-5], -21.0..-4.0, false),
            ([0.0; 3], -17.0..-15.0, false),
        ] {
            let places = sizes.map(|size| Scale::Log.place(size));
            let ruler = Scale::Log.ruler(places.into_iter());
            assert_eq!(ruler.range, range, "{sizes:?}");
            let [zero, small, large] = places.map(|place| ruler.map(&place, (480, 0)));
            assert_eq!(zero, 480);
            assert_eq!(small < zero, visible, "{sizes:?}: {small}");
            assert!(large <= small, "{sizes:?}: {large}");
        }
    }
}
