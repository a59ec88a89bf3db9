//! Where methods fail: the borders of the map, and what each class means.

use std::time::Instant;

use vpd::study::stability::stability;
use vpd::study::{Watch, all_methods};

use crate::study::shipped;

#[test]
fn the_map_of_the_dipole() {
    let scene = shipped("dipole");
    let begun = Instant::now();
    let map = stability(&scene, &all_methods(&scene), &Watch::default()).expect("a map");
    println!(
        "{:?}; scale {:.2e}, fastest {:.2}",
        begun.elapsed(),
        map.energy_scale,
        map.fastest_rad_s
    );
    for (cells, border) in map.cells.iter().zip(&map.borders) {
        let letters: Vec<&str> =
            cells.iter().map(|cell| cell.class.as_str()).map(|s| &s[..3]).collect();
        println!(
            "{:28} {:?} {:?} {} {}",
            border.label,
            border.usable_step_s,
            border.turn_rad,
            border.broken.unwrap_or("-"),
            letters.join(" ")
        );
    }
}
