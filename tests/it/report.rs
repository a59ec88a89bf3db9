//! What is said of the table of a sweep, next to what is known.

use std::fs;

use chacha20::ChaCha8Rng;
use chacha20::rand_core::{Rng, SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use serde_json::{Value, json};
use vpd::solve::so;
use vpd::sweep::statistics::{
    mean, mean_attitude, proportion, quantile, rank_correlation, ranks, sobol,
};

use crate::cli::{text, vpd};

fn normal(random: &mut ChaCha8Rng) -> f64 {
    StandardNormal.sample(random)
}

/// Of 2,000 samples from a normal distribution the intervals hold the quantile in 95 % or a little more: an interval between two
/// samples cannot be chosen more finely.
#[test]
fn intervals_of_quantiles_hold_as_often_as_they_say() {
    let mut random = ChaCha8Rng::seed_from_u64(1);
    // The quantiles of the normal distribution, and what the binomial distribution says of the coverage at best.
    for (part, truth) in [(0.5, 0.0), (0.05, -1.644_853_626_951_472), (0.9, 1.281_551_565_544_6)] {
        let mut held = 0;
        for _ in 0..2000 {
            let mut sample: Vec<f64> = (0..400).map(|_| normal(&mut random)).collect();
            sample.sort_by(f64::total_cmp);
            let found = quantile(&sample, part, 0.95);
            let (low, high) = (found.low.expect("bounded"), found.high.expect("bounded"));
            assert!(low <= found.value && found.value <= high);
            held += u32::from(low <= truth && truth <= high);
        }
        let coverage = f64::from(held) / 2000.0;
        println!("{part}: {coverage}");
        assert!((0.94..0.972).contains(&coverage), "{part}: {coverage}");
    }
    // Five samples do not bound the 5 %-quantile from below.
    let few = quantile(&[1.0, 2.0, 3.0, 4.0, 5.0], 0.05, 0.95);
    assert_eq!((few.low, few.value), (None, 1.2));
    assert!(few.high.is_some());
}

#[test]
fn intervals_of_probabilities_are_those_of_clopper_and_pearson() {
    // scipy.stats.binomtest(k, n).proportion_ci(0.95), SciPy 1.17
    for (k, n, low, high) in [
        (5, 20, 0.086_571_469_101, 0.491_045_871_708),
        (0, 30, 0.0, 0.115_703_308_222),
        (30, 30, 0.884_296_691_778, 1.0),
        (500, 1000, 0.468_549_172_972, 0.531_450_827_028),
    ] {
        let found = proportion(k, n, 0.95);
        let (found_low, found_high) = (found.low.expect("bounded"), found.high.expect("bounded"));
        assert!((found_low - low).abs() < 1e-8 && (found_high - high).abs() < 1e-8, "{found:?}");
    }
}

#[test]
fn ranks_and_their_correlation_take_equal_values() {
    let (x, y) = ([1.0, 2.0, 2.0, 4.0, 5.0], [2.0, 1.0, 3.0, 3.0, 9.0]);
    assert_eq!(ranks(&x), [1.0, 2.5, 2.5, 4.0, 5.0]);
    let found = rank_correlation(&ranks(&x), &ranks(&y), 0.95).expect("both change");
    // scipy.stats.spearmanr(x, y).statistic
    assert!((found.value - 0.763_157_894_736_842_1).abs() < 1e-15, "{found:?}");
    assert_eq!(rank_correlation(&ranks(&x), &ranks(&[3.0; 5]), 0.95), None);
    let (value, error) = mean(&[1.0, 2.0, 3.0, 4.0]);
    assert_eq!(value, 2.5);
    assert!((error - (5.0_f64 / 3.0).sqrt() / 2.0).abs() < 1e-15);
}

/// Ishigami's function with a = 7, b = 0.1: the indices are known (Saltelli et al. 2008, page 179).
#[test]
fn indices_of_sobol_are_those_of_ishigami() {
    let f = |x: [f64; 3]| {
        let (s, t) = (libm::sin(x[0]), libm::sin(x[1]));
        s + 7.0 * t * t + 0.1 * x[2].powi(4) * s + 1e3
    };
    let mut random = ChaCha8Rng::seed_from_u64(3);
    let mut point = || -> [f64; 3] {
        std::array::from_fn(|_| {
            let unit = (random.next_u64() >> 11) as f64 / (1_u64 << 53) as f64;
            std::f64::consts::PI * (2.0 * unit - 1.0)
        })
    };
    let rows: Vec<Vec<f64>> = (0..8192)
        .map(|_| {
            let (a, b) = (point(), point());
            let mixed =
                (0..3).map(|k| f(std::array::from_fn(|i| if i == k { b[i] } else { a[i] })));
            [f(a), f(b)].into_iter().chain(mixed).collect()
        })
        .collect();
    let found = sobol(&rows, 0.999);
    for (of, (first, total)) in
        found.iter().zip([(0.3139, 0.5576), (0.4424, 0.4424), (0.0, 0.2437)])
    {
        for (figure, truth) in [(of.first, first), (of.total, total)] {
            let (low, high) = (figure.low.expect("closed"), figure.high.expect("closed"));
            assert!(low <= truth && truth <= high && high - low < 0.15, "{figure:?}, {truth}");
        }
    }
}

#[test]
fn attitudes_have_a_mean_and_a_covariance() {
    let mut random = ChaCha8Rng::seed_from_u64(5);
    let deviations = [0.1, 0.3, 0.02];
    let centre = so::exp(&so::hat::<3>(&[0.4, -2.0, 1.0]));
    let quaternion = |g: so::Mat<3>| {
        let g = nalgebra::Rotation3::from_matrix_unchecked(g);
        let q = nalgebra::UnitQuaternion::from_rotation_matrix(&g);
        [q.w, q.i, q.j, q.k]
    };
    let all: Vec<[f64; 4]> = (0..20_000)
        .map(|k| {
            let turn = deviations.map(|deviation| deviation * normal(&mut random));
            let q = quaternion(centre * so::exp(&so::hat(&turn)));
            // The same attitude either way.
            if k % 2 == 0 { q } else { q.map(|x| -x) }
        })
        .collect();
    let found = mean_attitude(&all).expect("a mean");
    let off: f64 = found.quaternion.iter().zip(quaternion(centre)).map(|(a, b)| a * b).sum();
    assert!(off.abs() > 1.0 - 1e-4, "{off}");
    for (i, deviation) in deviations.iter().enumerate() {
        let ratio = found.covariance_rad2[i][i].sqrt() / deviation;
        assert!((0.97..1.03).contains(&ratio), "{i}: {ratio}");
    }
    let one = mean_attitude(&all[..1]).expect("one");
    assert!(one.covariance_rad2.iter().flatten().all(|x| x.abs() < 1e-28), "{one:?}");
}

/// A pendulum's largest speed goes by its tilt and hardly by its inertia about the vertical; the table says so, and a half-finished one
/// too.
#[test]
fn the_command_reports_on_a_sweep() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    let uniform = |from: f64, to: f64| json!({"uniform": {"from": from, "to": to, "count": 128}});
    let sweep = json!({
        "scenario": {
            "name": "pendulum & co", "step_s": 0.02, "duration_s": 3, "log": {"every": 1},
            "scene": {
                "inertia": {"principal": [1.0, 1.0, 0.2]},
                "potential": [{"kind": "uniform", "weight": 9.8, "body_point": [0, 0, -0.5], "direction": [0, 0, 1]}],
                "initial": {"attitude": {"axis_angle": {"axis": [1, 0, 0], "angle_rad": 0.5}}}
            }
        },
        "vary": [
            {"name": "tilt", "pointer": "/scene/initial/attitude/axis_angle/angle_rad", "values": uniform(0.2, 1.2)},
            {"name": "axial", "pointer": "/scene/inertia/principal/2", "values": uniform(0.1, 0.3)}
        ],
        "combine": "saltelli", "seed": 4,
        "scores": [{"name": "speed", "measure": {"largest": "angular_speed"}}]
    });
    fs::write(folder.join("swing.json"), sweep.to_string()).expect("written");
    let swept = vpd(folder, &["sweep", "swing.json"]);
    assert_eq!(swept.status.code(), Some(0), "{}", text(&swept.stderr));
    let table = fs::read_to_string(folder.join("swing.csv")).expect("a table");
    assert_eq!(table.lines().count(), 1 + 64 * 4);
    let report = |more: &[&str]| {
        let arguments = [&["report", "swing.json"], more].concat();
        let found = vpd(folder, &arguments);
        assert_eq!(found.status.code(), Some(0), "{}", text(&found.stderr));
        text(&found.stdout).to_owned()
    };
    let more = [
        "--json",
        "--probability",
        "speed<2",
        "--probability",
        "speed > 0",
        "--html",
        "swing.html",
    ];
    let found: Value = serde_json::from_str(&report(&more)).expect("JSON");
    assert_eq!(found["counts"]["succeeded"], 256);
    let columns = found["columns"].as_array().expect("columns");
    let speed = columns.iter().find(|column| column["name"] == "speed").expect("the score");
    let index =
        |field: &str, kind: &str| speed["sobol"][field][kind]["value"].as_f64().expect("a number");
    assert!(index("tilt", "first") > 0.8 && index("tilt", "total") > 0.9, "{speed}");
    assert!(index("axial", "first").abs() < 0.05 && index("axial", "total") < 0.01, "{speed}");
    let rank = &speed["rank_correlations"]["tilt"]["value"];
    assert!(rank.as_f64().expect("a number") > 0.999, "{rank}");
    let median = &speed["quantiles"][1];
    assert!(median[1]["low"].as_f64() < median[1]["value"].as_f64(), "{median}");
    assert_eq!(found["probabilities"][1]["part"]["value"], 1.0);
    let below = found["probabilities"][0]["part"]["value"].as_f64().expect("a number");
    assert!((0.1..0.9).contains(&below), "{below}");
    let page = fs::read_to_string(folder.join("swing.html")).expect("a page");
    assert!(page.contains("pendulum &amp; co") && page.matches("<svg").count() >= 4);
    let words = report(&[]);
    assert!(
        words.contains("rank correlation") && words.contains("of tilt  first index"),
        "{words}"
    );
    // So far as it is there: a table that is not finished.
    let lines: Vec<&str> = table.lines().collect();
    fs::write(folder.join("half.csv"), lines[..101].join("\n") + "\n").expect("written");
    let half: Value = serde_json::from_str(&report(&["--json", "-t", "half.csv"])).expect("JSON");
    assert_eq!((&half["counts"]["succeeded"], &half["missing"]), (&json!(100), &json!(156)));
    for (arguments, words) in [
        (["--probability", "spede<2"], "there is no column \"spede\""),
        (["--probability", "tilt<2"], "there is no column \"tilt\""),
        (["--probability", "speed=2"], "is not of the form"),
        (["--quantiles", "1.5"], "above 0 and below 1"),
        (["-t", "absent.csv"], "absent.csv"),
    ] {
        let refused = vpd(folder, &[&["report", "swing.json"], &arguments[..]].concat());
        assert!(matches!(refused.status.code(), Some(1 | 2)), "{arguments:?}");
        assert!(text(&refused.stderr).contains(words), "{}", text(&refused.stderr));
    }
    let mut odd = sweep.clone();
    odd["vary"][1]["values"] = json!({"linear": {"from": 0.1, "to": 0.3, "count": 128}});
    fs::write(folder.join("odd.json"), odd.to_string()).expect("written");
    let refused = vpd(folder, &["sweep", "odd.json"]);
    assert_eq!(refused.status.code(), Some(2));
    assert!(text(&refused.stderr).contains("/vary/1/values"), "{}", text(&refused.stderr));
}
