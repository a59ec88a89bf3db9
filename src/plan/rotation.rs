//! Rotations, skew matrices and directions, as they stand in a scenario.

use nalgebra::{DMatrix, DVector, Matrix3, Quaternion, UnitQuaternion, Vector3};

use crate::scenario::{Attitude, Entry, ScenarioError, Sequence};
use crate::solve::so;
use crate::solve::so3;

pub(super) fn rows(rows: &[Vec<f64>]) -> DMatrix<f64> {
    DMatrix::from_fn(rows.len(), rows.len(), |i, j| rows[i][j])
}

/// Largest distance of a start from a valid state. Decimal text of a rotation is off by its last
/// digit; more than this is another matrix.
pub(crate) const MOST_DEFECT: f64 = 1e-8;

/// Returns the rotation that stands at `at`; the identity if none is given.
pub(super) fn attitude(
    at: &str,
    given: Option<&Attitude>,
    n: usize,
) -> Result<DMatrix<f64>, ScenarioError> {
    let from_quaternion = |w: f64, x: f64, y: f64, z: f64| {
        let rotation =
            UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z)).to_rotation_matrix();
        DMatrix::from_iterator(3, 3, rotation.matrix().iter().copied())
    };
    match given {
        None => Ok(DMatrix::identity(n, n)),
        Some(Attitude::Quaternion([w, x, y, z])) => Ok(from_quaternion(*w, *x, *y, *z)),
        Some(Attitude::AxisAngle(turn)) => {
            let axis = Vector3::from(turn.axis).normalize();
            let given = [turn.angle_rad, turn.angle_deg].map(|angle| angle.map(|angle| [angle]));
            let [angle] = in_radians(given);
            let half = 0.5 * angle;
            let (w, v) = (libm::cos(half), axis * libm::sin(half));
            Ok(from_quaternion(w, v.x, v.y, v.z))
        }
        Some(Attitude::Euler(euler)) => {
            Ok(turns(euler.sequence, in_radians([euler.angles_rad, euler.angles_deg])))
        }
        Some(Attitude::RollPitchYaw(given)) => {
            let [roll, pitch, yaw] = in_radians([given.angles_rad, given.angles_deg]);
            Ok(turns(Sequence::Zyx, [yaw, pitch, roll]))
        }
        Some(Attitude::Mrp([x, y, z])) => {
            // cos(angle / 2) and axis sin(angle / 2), from p = axis tan(angle / 4), both times 1 + p^2
            // (Schaub, Junkins 1996, Journal of the Astronautical Sciences 44, 1).
            let square = x * x + y * y + z * z;
            Ok(from_quaternion(1.0 - square, 2.0 * x, 2.0 * y, 2.0 * z))
        }
        Some(Attitude::Matrix(given)) => {
            let g = rows(given);
            let pointer = format!("{at}/matrix");
            let defect = (g.transpose() * &g - DMatrix::identity(n, n)).amax();
            if !(defect <= MOST_DEFECT) {
                let message = format!(
                    "is not orthogonal: g^T g differs from I by {defect:.1e}, at most {MOST_DEFECT:e} is allowed: give more digits, or `quaternion` or `axis_angle`"
                );
                return Err(ScenarioError::invalid(pointer, message));
            }
            if g.determinant() < 0.0 {
                let message = "is a reflection: its determinant is -1, a rotation has +1";
                return Err(ScenarioError::invalid(pointer, message));
            }
            Ok(g)
        }
    }
}

/// Returns angles in radians that are given in radians or in degrees.
fn in_radians<const K: usize>([rad, deg]: [Option<[f64; K]>; 2]) -> [f64; K] {
    // Exact for a quarter turn, and its multiples.
    let converted = |angles: [f64; K]| angles.map(|deg| deg / 180.0 * std::f64::consts::PI);
    rad.or(deg.map(converted)).expect("the check of the scenario saw one of the two")
}

/// Returns the rotation of three turns, each about an axis of the body as it is by then.
fn turns(sequence: Sequence, angles: [f64; 3]) -> DMatrix<f64> {
    let about = |axis: usize, angle: f64| {
        let (j, k) = ((axis + 1) % 3, (axis + 2) % 3);
        let (s, c) = (libm::sin(angle), libm::cos(angle));
        let mut turn = DMatrix::identity(3, 3);
        (turn[(j, j)], turn[(k, k)]) = (c, c);
        (turn[(j, k)], turn[(k, j)]) = (-s, s);
        turn
    };
    let [first, second, third] = [0, 1, 2].map(|i| about(sequence.axes()[i], angles[i]));
    first * second * third
}

/// Returns the axis of a rotation for n = 3, of length one, and its angle in radians, from 0 to pi.
pub(crate) fn axis_and_angle(attitude: &DMatrix<f64>) -> ([f64; 3], f64) {
    let g = Matrix3::from_fn(|i, j| attitude[(i, j)]);
    let q = so3::unit(&g);
    let q = if q.w < 0.0 { -q } else { q };
    let v = q.vector().into_owned();
    let size = v.norm();
    let axis = if size > 0.0 { v / size } else { Vector3::z() };
    (axis.into(), 2.0 * libm::atan2(size, q.w))
}

/// Returns the skew matrix of a 3-vector or of rows.
pub(super) fn skew(entries: &[Entry]) -> DMatrix<f64> {
    let numbers: Vec<f64> = entries
        .iter()
        .filter_map(|e| if let Entry::Number(x) = e { Some(*x) } else { None })
        .collect();
    if let Ok(vector) = <[f64; 3]>::try_from(numbers.as_slice()) {
        return DMatrix::from_iterator(3, 3, so::hat::<3>(&vector).iter().copied());
    }
    let given: Vec<Vec<f64>> = entries
        .iter()
        .filter_map(|e| if let Entry::Row(row) = e { Some(row.clone()) } else { None })
        .collect();
    let a = rows(&given);
    // Exactly skew: text may leave the two halves a digit apart.
    (&a - a.transpose()) * 0.5
}

/// Returns the direction of a vector.
pub(super) fn unit_vector(v: &[f64]) -> DVector<f64> {
    DVector::from_column_slice(v).normalize()
}

/// Returns the part of a vector across a unit vector, of length one.
pub(super) fn across(v: &[f64], unit: &DVector<f64>) -> DVector<f64> {
    let v = unit_vector(v);
    let rest = &v - unit * unit.dot(&v);
    (&rest - unit * unit.dot(&rest)).normalize()
}
