//! Spread of the attitudes of an ensemble over time, from the points on the way of its members.

use super::messages::Waypoints;

/// Sums over the members at the times of their points.
#[derive(Debug, Default)]
pub(super) struct Spread {
    times: Vec<Sums>,
}

#[derive(Debug)]
struct Sums {
    time_s: f64,
    members: u64,
    /// An attitude near all others, so that small differences keep their digits.
    near: Vec<f64>,
    /// Sum of the differences from it, and of their squares.
    sum: Vec<f64>,
    squares: f64,
}

impl Spread {
    /// Adds a member.
    pub(super) fn add(&mut self, way: &Waypoints) {
        let entries = way.attitude.len() / way.time_s.len().max(1);
        if entries == 0 {
            return;
        }
        for (&time_s, attitude) in way.time_s.iter().zip(way.attitude.chunks_exact(entries)) {
            let attitude: Vec<f64> = attitude.iter().copied().map(f64::from).collect();
            let at = self.times.partition_point(|sums| sums.time_s < time_s);
            let known = self.times.get(at).is_some_and(|sums| sums.time_s == time_s);
            if !known {
                let (near, sum) = (attitude.clone(), vec![0.0; entries]);
                self.times.insert(at, Sums { time_s, members: 0, near, sum, squares: 0.0 });
            }
            let sums = &mut self.times[at];
            if sums.near.len() == entries {
                sums.add(&attitude);
            }
        }
    }

    /// Returns times in seconds, and the root mean square of |g - mean| / sqrt 2 (Frobenius), the mean being the rotation nearest
    /// to that of the attitudes: where most members are, so not at the times at which some failed.
    pub(super) fn points(&self) -> impl Iterator<Item = (f64, f64)> {
        let most = self.times.iter().map(|sums| sums.members).max().unwrap_or_default();
        let shared = self.times.iter().filter(move |sums| 2 * sums.members > most.max(2));
        shared.map(|sums| (sums.time_s, sums.spread()))
    }
}

impl Sums {
    fn add(&mut self, attitude: &[f64]) {
        self.members += 1;
        for ((sum, near), x) in self.sum.iter_mut().zip(&self.near).zip(attitude) {
            *sum += x - near;
            self.squares += (x - near) * (x - near);
        }
    }

    /// With d the differences from g0: `|g - R|^2 = |d|^2 - 2 <d, R - g0> + |R - g0|^2`.
    fn spread(&self) -> f64 {
        let members = self.members as f64;
        let mean: Vec<f64> =
            self.near.iter().zip(&self.sum).map(|(near, sum)| near + sum / members).collect();
        let rotation = nearest_rotation(mean);
        let mut square = self.squares / members;
        for ((near, sum), x) in self.near.iter().zip(&self.sum).zip(rotation) {
            square += (x - near) * (x - near - 2.0 * sum / members);
        }
        (0.5 * square).max(0.0).sqrt()
    }
}

/// The orthogonal factor of a mean of rotations, by the iteration `X <- X (3 I - X^T X) / 2` (Higham 2008, Functions of Matrices,
/// 8.20): its singular values are at most one. Of attitudes all over the group it is not determined, and any will do.
fn nearest_rotation(mut x: Vec<f64>) -> Vec<f64> {
    const MOST_STEPS: u32 = 60;
    let n = x.len().isqrt();
    for _ in 0..MOST_STEPS {
        let column_product =
            |i: usize, j: usize| (0..n).map(|k| x[n * k + i] * x[n * k + j]).sum::<f64>();
        let square: Vec<f64> = (0..n * n).map(|at| column_product(at / n, at % n)).collect();
        let entry = |i: usize, j: usize| {
            let product = (0..n).map(|k| x[n * i + k] * square[n * k + j]).sum::<f64>();
            1.5 * x[n * i + j] - 0.5 * product
        };
        let next: Vec<f64> = (0..n * n).map(|at| entry(at / n, at % n)).collect();
        if next == x {
            break;
        }
        x = next;
    }
    x
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Members at angles a and -a about one axis: the mean is no turn, and the spread `2 sin(a / 2)`, to single precision.
    #[test]
    fn two_members_lie_at_their_angle_from_the_mean() {
        for angle in [1e-4_f64, 0.3, 1.2] {
            let mut spread = Spread::default();
            for turn in [angle, -angle] {
                let (sin, cos) = (libm::sin(turn), libm::cos(turn));
                let attitude = [cos, -sin, 0.0, sin, cos, 0.0, 0.0, 0.0, 1.0].map(|x| x as f32);
                let way = Waypoints {
                    time_s: vec![2.0],
                    attitude: attitude.to_vec(),
                    ..Waypoints::default()
                };
                spread.add(&way);
            }
            let points: Vec<_> = spread.points().collect();
            assert_eq!(points.len(), 1);
            let (time_s, found) = points[0];
            let expected = 2.0 * libm::sin(angle / 2.0);
            assert!(time_s == 2.0 && (found - expected).abs() < 1e-7, "{angle}: {found:e}");
        }
    }
}
