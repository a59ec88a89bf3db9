//! The examples do what they say.

#[path = "../../examples/chain.rs"]
mod chain;
#[path = "../../examples/close_encounter.rs"]
mod close_encounter;
#[path = "../../examples/custom_hamiltonian.rs"]
mod custom_hamiltonian;
#[path = "../../examples/free_body.rs"]
mod free_body;
#[path = "../../examples/so4.rs"]
mod so4;

#[test]
fn a_free_body_keeps_its_energy_and_its_momentum() {
    let (energy, length) = free_body::run().expect("a run");
    assert!(energy < 1e-6 && length < 1e-13, "{energy:e} {length:e}");
}

#[test]
fn a_close_encounter_needs_steps_that_adapt() {
    let [adaptive, fixed] = close_encounter::run().expect("a run");
    let (energy, _) = adaptive.expect("they pass");
    assert!(energy < 1e-6, "{energy:e}");
    assert!(fixed.is_none_or(|(lost, _)| lost > 1e-2), "{fixed:?}");
}

#[test]
fn a_body_in_four_dimensions() {
    let so4::Largest { energy, orthogonality, drift } = so4::run().expect("a run");
    assert!(energy < 1e-8, "{energy:e}");
    assert!(orthogonality < 1e-14 && drift < 1e-12, "{orthogonality:e} {drift:e}");
}

#[test]
fn a_hamiltonian_of_ones_own() {
    let [large, group, drift] = custom_hamiltonian::run(0.1).expect("a run");
    assert!(large < 1e-4 && group < 1e-14 && drift < 1e-12, "{large:e} {group:e} {drift:e}");
    // The method has order 4.
    let [small, ..] = custom_hamiltonian::run(0.05).expect("a run");
    assert!(large / small > 12.0, "{large:e} {small:e}");
}

#[test]
fn a_chain_keeps_its_energy_and_its_joints() {
    let [energy, gap] = chain::run().expect("a run");
    assert!(energy < 1e-6 && gap < 5e-15, "{energy:e} {gap:e}");
}
