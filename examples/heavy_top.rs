//! The library's front door: a scenario from text, its plan, a run that is followed, and the log read back.
//!
//!     cargo run --release --example heavy_top

use std::error::Error;
use std::io::Write;

use vpd::advise;
use vpd::log::reader::{Message, read_samples};
use vpd::run::{Control, JobContext, execute};
use vpd::scenario::Scenario;

const TOP: &str = r#"{
    "name": "heavy-top",
    "scene": {
        "inertia": { "principal": [0.02, 0.02, 0.01] },
        "potential": [
            { "kind": "uniform", "weight": 4.905, "body_point": [0, 0, 0.1], "direction": [0, 0, 1] }
        ],
        "initial": {
            "attitude": { "axis_angle": { "axis": [1, 0, 0], "angle_rad": 0.3 } },
            "angular_velocity": { "body": [0, 0, 40] }
        }
    },
    "step_s": 0.002,
    "duration_s": 2
}"#;

fn main() -> Result<(), Box<dyn Error>> {
    let mut out = std::io::stdout();
    let scenario = Scenario::from_json(TOP.as_bytes())?;
    let plan = advise::plan(&scenario)?;
    writeln!(out, "{} steps, about {} bytes of log", plan.steps, plan.log_bytes)?;

    // Another thread may read the progress of `control`, or set it to stop the run.
    let control = Control::default();
    let log = std::env::temp_dir().join("heavy-top.mcap");
    let summary = execute(&plan, &JobContext { log: &log, control: &control })?;
    writeln!(out, "{}: {} steps", summary.outcome.as_str(), summary.steps)?;
    if let Some(diagnosis) = &summary.diagnosis {
        writeln!(out, "{diagnosis}")?;
    }

    // Nutation of the axis of the top: its height is the last entry of the attitude.
    let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
    read_samples(&log, |_, message| {
        if let Message::State(state) = message {
            let height = state.attitude[8];
            (low, high) = (low.min(height), high.max(height));
        }
    })?;
    writeln!(out, "the axis points up by {low:.4} to {high:.4}")?;
    Ok(())
}
