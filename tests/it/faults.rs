//! Faults in the real binary: kills, stops, full and failing disks, damaged files, nonsense on the
//! wire.
//!
//! Each test prints its seed (`VPD_SEED` sets another one) and counts that its faults were given; `VPD_FAULTS=20`
//! gives twenty times as many.

mod clock;
mod damage;
pub(crate) mod disk;
mod hostile;
mod handles;
mod kill;
mod load;
mod moved;
mod process;
mod viewers;
mod wire;

use serde_json::{Value, json};

/// Returns how many times more faults are made than in CI.
pub(crate) fn scale() -> usize {
    std::env::var("VPD_FAULTS").ok().and_then(|text| text.parse().ok()).unwrap_or(1)
}

/// Random numbers of a test; the seed is printed, so that it can be run again.
struct Random(u64);

impl Random {
    fn new() -> Self {
        let given = std::env::var("VPD_SEED").ok().and_then(|text| text.parse().ok());
        let seed = given.unwrap_or_else(|| {
            let clock = std::time::UNIX_EPOCH.elapsed().expect("after 1970");
            clock.as_nanos() as u64 | 1
        });
        println!("VPD_SEED={seed}");
        Self(seed)
    }

    fn below(&mut self, end: usize) -> usize {
        (super::log::next(&mut self.0) >> 16) as usize % end
    }
}

/// Returns a dipole of `steps` steps, every fifth of them logged: a chunk, and so a checkpoint,
/// each 30 ms or so.
fn dipole(steps: u64) -> Value {
    let mut scenario: Value =
        serde_json::from_str(include_str!("../../scenarios/dipole.json")).expect("shipped");
    scenario["steps"] = json!(steps);
    scenario["log"] = json!({ "every": 5 });
    scenario
}

/// Returns a body of n dimensions on many springs: steps that take long.
fn heavy(n: usize, terms: usize, steps: u64) -> Value {
    let at = |k: usize, length: f64| -> Vec<f64> {
        (0..n).map(|i| if i == k % n { length } else { 0.1 * ((i + k) % 3) as f64 }).collect()
    };
    let springs = (0..terms).map(|k| {
        json!({ "kind": "spring", "stiffness": 1.0, "rest_length": 0.3,
                "body_point": at(k, 1.0), "position": at(k + 1, 2.0) })
    });
    let moments: Vec<f64> = (0..n).map(|i| 1.0 + 0.1 * i as f64).collect();
    json!({
        "name": "heavy",
        "scene": { "inertia": { "second_moments": moments }, "potential": springs.collect::<Vec<_>>() },
        "method": { "name": "vpd", "tableau": "gauss4" },
        "step_s": 0.01, "steps": steps,
    })
}

/// Returns a pendulum whose method and step are to be found.
fn pendulum(error: f64, duration_s: f64) -> Value {
    let mut scenario: Value =
        serde_json::from_str(include_str!("../../scenarios/pendulum.json")).expect("shipped");
    for field in ["method", "step_s", "steps", "expect"] {
        scenario.as_object_mut().expect("an object").remove(field);
    }
    scenario["accuracy"] = json!({ "error": error });
    scenario["duration_s"] = json!(duration_s);
    scenario
}

/// Damages a file: a flipped bit, a cut, or 512 bytes of zeros, none of which may leave it as it was.
fn damage(random: &mut Random, bytes: &[u8]) -> Vec<u8> {
    let mut damaged = bytes.to_vec();
    let at = random.below(bytes.len());
    match random.below(3) {
        0 => damaged[at] ^= 1 << random.below(8),
        1 => damaged.truncate(at),
        _ => {
            let end = (at + 512).min(bytes.len());
            damaged[at..end].fill(0);
        }
    }
    if damaged == bytes {
        damaged[at] ^= 1;
    }
    damaged
}
