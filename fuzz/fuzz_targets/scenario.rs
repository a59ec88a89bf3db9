//! Any text: a scenario that can be planned and printed, or an error that names its field.
#![no_main]

use libfuzzer_sys::fuzz_target;
use vpd::plan::Plan;
use vpd::scenario::Scenario;

fuzz_target!(|text: &[u8]| {
    let Ok(scenario) = Scenario::from_json(text) else { return };
    let again = Scenario::from_json(&scenario.to_json()).expect("what is printed is read back");
    assert_eq!(again, scenario);
    if let Ok(plan) = Plan::new(&scenario) {
        assert!(plan.run_s.is_finite() && plan.samples_per_chunk > 0);
    }
});
