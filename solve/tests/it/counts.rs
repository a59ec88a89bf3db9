//! What a step takes: sweeps, passes and torques of every solver at a few step lengths on three scenes, next to a file that
//! was looked at. A guess that is lost shows here, where no accuracy does.

use std::fmt::Write;
use std::{fs, path::PathBuf};

use vpd_solve::hamiltonian::RigidBody;
use vpd_solve::nonlinear::StopRule;
use vpd_solve::state::State;
use vpd_solve::stepper::Stepper;
use vpd_solve::stepper::quaternion_gauss::QuaternionGauss;
use vpd_solve::stepper::vpd::Vpd;
use vpd_solve::stepper::vpd_lagrangian::VpdLagrangian;
use vpd_solve::stepper::vpd_so3::VpdSo3;
use vpd_solve::stepper::vrkmk::Vrkmk;
use vpd_solve::tableau::Tableau;
use vpd_solve::work::Work;

use crate::driven;
use crate::given::{Numbers, dipole};
use crate::laws;

const STEPS: u32 = 100;
const TABLEAUX: [(usize, [f64; 2]); 6] = [
    (1, [0.002, 0.01]),
    (2, [0.01, 0.05]),
    (3, [0.02, 0.05]),
    (4, [0.05, 0.1]),
    (6, [0.05, 0.1]),
    (8, [0.1, 0.2]),
];

type Scene = fn() -> (RigidBody<3>, State<3>);

/// A line: the work of a step, as a mean over [`STEPS`].
fn line<const N: usize>(
    page: &mut String,
    scene: &str,
    method: &str,
    (stages, h): (usize, f64),
    stepper: &mut dyn Stepper<N>,
    (body, start): (RigidBody<N>, State<N>),
) {
    let body = body.with_work(Work::default());
    stepper.start(&start);
    for k in 0..STEPS {
        stepper.set_time(f64::from(k) * h);
        stepper.step(&body, h).unwrap_or_else(|failure| panic!("{scene}, {method}: {failure:?}"));
    }
    let work = body.work();
    let [sweeps, passes, gradients] = [work.sweeps(), work.passes(), work.gradients()]
        .map(|count| count as f64 / f64::from(STEPS));
    writeln!(
        page,
        "| {scene} | {method} | {stages} | {h} | {sweeps:.2} | {passes:.2} | {gradients:.2} |"
    )
    .expect("memory takes what is written");
}

fn page() -> String {
    let mut page = String::from(
        "# The work of a step\n\nMeans over 100 steps: sweeps over all unknowns, passes within sweeps, torques of all stages. \
         Written by `cargo test --release -p vpd-solve rewrite_the_counts -- --ignored`; a test compares.\n\n\
         | scene | method | stages | h | sweeps | passes | torques |\n|---|---|---|---|---|---|---|\n",
    );
    for (stages, steps) in TABLEAUX {
        let gauss = || Tableau::gauss(stages).expect("1 to 8 stages");
        let stop = StopRule::default;
        for h in steps {
            let at = (stages, h);
            let scenes: [(&str, Scene); 3] = [
                ("dipole", dipole),
                ("one term of each kind", || {
                    let mut numbers = Numbers(7);
                    let body = laws::body::<3>(&mut numbers);
                    let (attitude, momentum) = (numbers.rotation(), numbers.skew());
                    (body, State { attitude, momentum })
                }),
                ("satellite", || driven::satellite(0.1, 3)),
            ];
            for (name, scene) in scenes {
                let mut steppers: Vec<(&str, Box<dyn Stepper<3>>)> = vec![
                    ("vpd in lanes", Box::new(VpdSo3::new(gauss(), stop()).expect("8 at most"))),
                    ("vpd in matrices", Box::new(Vpd::new(gauss(), stop()))),
                    ("vpd_lagrangian", Box::new(VpdLagrangian::new(gauss(), stop()))),
                    ("vrkmk", Box::new(Vrkmk::new(gauss(), stop()))),
                ];
                if name != "satellite" {
                    let quaternions = QuaternionGauss::new(stages, stop()).expect("8 at most");
                    steppers.push(("quaternion_gauss", Box::new(quaternions)));
                }
                for (method, mut stepper) in steppers {
                    line(&mut page, name, method, at, stepper.as_mut(), scene());
                }
            }
            let mut numbers = Numbers(8);
            let body = laws::body::<5>(&mut numbers);
            let start = State { attitude: numbers.rotation(), momentum: numbers.skew() };
            let scene = (body, start);
            line(&mut page, "n = 5", "vpd", at, &mut Vpd::new(gauss(), stop()), scene.clone());
        }
    }
    page
}

fn file() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/data/counts.md")
}

#[test]
fn the_work_of_a_step_is_as_reviewed() {
    let (page, kept) = (page(), fs::read_to_string(file()).expect("the file"));
    for (line, kept) in page.lines().zip(kept.lines()) {
        assert_eq!(line, kept, "see rewrite_the_counts");
    }
    assert_eq!(page.len(), kept.len(), "see rewrite_the_counts");
}

/// Writes what the steps take; look at the difference before it is kept.
#[test]
#[ignore = "writes a file that a test reads: cargo test --release rewrite_the_counts -- --ignored"]
fn rewrite_the_counts() {
    fs::write(file(), page()).expect("the file is written");
}
