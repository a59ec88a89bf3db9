//! The terms of the potential, combined: a scene gives them in many pieces, and only some have to
//! be modelled.
//!
//! Terms of one law add up before the run where they are one function of the attitude, in several pieces:
//!
//! ```text
//! uniform field                w d . (g y)
//! spring of no length at rest  k/2 |g y - z|^2 = k/2 (|y|^2 + |z|^2) - k z . (g y)
//! gravity gradient             s/2 (g^T d) . M (g^T d) = tr(g^T (s d d^T) g M) / 2
//! ```
//!
//! The first two are linear in `d y^T`, so any number of them are `sum_i D_i . (g Y_i)` with independent directions `D_i`
//! taken from among theirs, or independent points: at most n, and none if they cancel. Gradients along one direction add
//! their matrices; with one matrix they add `s d d^T`, and a multiple of I there pulls alike at every attitude.
//!
//! Invariant: at every attitude the modelled terms and the constant sum to the given ones, up to
//! the rounding of the sum.

use nalgebra::allocator::Allocator;
use nalgebra::{DMatrix, DVector, DefaultAllocator, Dim, Dyn, OMatrix};

use super::{Model, TermPlan};
use crate::scenario::{GravityGradient, PotentialTerm, Uniform};
use crate::solve::compensated::two_sum;

/// Relative error of a number by rounding: a few units in its last place.
const ROUNDED: f64 = 8.0 * f64::EPSILON;
/// Limit of what is left out: terms that move the body by less than this part of the total, and by
/// less than this in radians.
const UNSEEN: f64 = 1e-16;

const DEPENDS: &str = "depends on the attitude";
const STANDS: &str = "depends on the attitude; others are merged into it";
const UNIFORM: &str = "uniform fields add up";
const SPRING: &str = "a spring with rest length 0 is a uniform field, and those add up";
const EQUAL: &str = "they act between the same points";
const ALONG: &str = "their directions are parallel";

/// The terms of a scene on the way to those that are modelled.
pub(super) struct Terms {
    /// The given terms that are still modelled, as changed.
    left: Vec<Option<PotentialTerm>>,
    plans: Vec<TermPlan>,
    constant: f64,
}

/// Size of the motion, and its duration.
pub(super) struct Extent {
    pub(super) duration_s: f64,
    /// Size of the momentum at the start.
    pub(super) momentum: f64,
    /// Largest velocity for a momentum of one.
    pub(super) mobility: f64,
}

impl Terms {
    /// Takes the terms of the scene, each with every default filled in; those that do not depend on
    /// the attitude are left out.
    pub(super) fn new(given: &[PotentialTerm]) -> Self {
        let mut terms = Self { left: Vec::new(), plans: Vec::new(), constant: 0.0 };
        for (index, term) in given.iter().enumerate() {
            let pointer = format!("/scene/potential/{index}");
            terms.plans.push(TermPlan { pointer, kept: true, why: DEPENDS.to_owned() });
            terms.left.push(Some(term.clone()));
            if let Some((value, why)) = term.law().constant() {
                terms.constant += value;
                terms.leave_out(index, why.to_owned());
            }
        }
        terms
    }

    /// Returns the terms left.
    pub(super) fn modelled(&self) -> impl Iterator<Item = &PotentialTerm> {
        self.left.iter().flatten()
    }

    /// Combines terms that are one, and leaves out those too weak to be seen.
    pub(super) fn put_together(mut self, extent: &Extent, model: &Model) -> Self {
        self.add_uniform();
        self.add_equal();
        self.add_isotropic();
        self.add_along();
        self.leave_out_unseen(extent, model);
        self
    }

    /// Returns the modelled terms, the constant added to them, and what became of each term.
    pub(super) fn into_parts(self) -> (Vec<PotentialTerm>, f64, Vec<TermPlan>) {
        (self.left.into_iter().flatten().collect(), self.constant, self.plans)
    }

    fn leave_out(&mut self, index: usize, why: String) {
        self.left[index] = None;
        (self.plans[index].kept, self.plans[index].why) = (false, why);
    }

    fn merge(&mut self, index: usize, into: &[usize], law: &str) {
        let into: Vec<&str> = into.iter().map(|&i| self.plans[i].pointer.as_str()).collect();
        self.leave_out(index, format!("merged into {}: {law}", into.join(", ")));
    }

    /// Leaves out terms that sum to nothing.
    fn cancel(&mut self, indices: &[usize]) {
        for (place, &index) in indices.iter().enumerate() {
            let other = indices[usize::from(place == 0)];
            self.leave_out(index, format!("cancels with {}", self.plans[other].pointer));
        }
    }

    /// Makes the term stand for others, too.
    fn stands(&mut self, index: usize, term: PotentialTerm) {
        self.left[index] = Some(term);
        self.plans[index].why = STANDS.to_owned();
    }

    /// Combines uniform fields, and springs of no length at rest, into as few as there are
    /// independent directions or points.
    fn add_uniform(&mut self) {
        let linear = |(k, term): (usize, &Option<PotentialTerm>)| {
            term.as_ref().and_then(Linear::of).map(|linear| (k, linear))
        };
        let (at, parts): (Vec<usize>, Vec<Linear>) =
            self.left.iter().enumerate().filter_map(linear).unzip();
        let directions = Basis::of(parts.iter().map(|part| &part.direction));
        let points = Basis::of(parts.iter().map(|part| &part.point));
        let by_direction = directions.members.len() <= points.members.len();
        let basis = if by_direction { directions } else { points };
        if basis.members.len() == parts.len() {
            return;
        }
        // The other factor of a vector of the basis, and whether it is zero.
        let other = |part: &Linear| {
            (if by_direction { &part.point } else { &part.direction }).clone() * part.weight
        };
        let totals: Vec<(DVector<f64>, bool)> = (0..basis.members.len())
            .map(|i| {
                let summands: Vec<DVector<f64>> =
                    basis.shares(i).map(|k| other(&parts[k]) * basis.coordinates[k][i]).collect();
                let (total, size) = sum(&summands);
                let gone = total.amax() <= ROUNDED * size;
                (total, gone)
            })
            .collect();
        for (k, part) in parts.iter().enumerate() {
            let by: Vec<usize> = basis.vectors_of(k).collect();
            let member = basis.members.iter().position(|&member| member == k);
            if member.is_some_and(|i| basis.shares(i).count() == 1) {
                continue;
            }
            self.constant += part.constant;
            let into: Vec<usize> =
                by.iter().filter(|&&i| !totals[i].1).map(|&i| at[basis.members[i]]).collect();
            match member {
                Some(i) if !into.is_empty() => {
                    let list = |v: &DVector<f64>| v.iter().copied().collect::<Vec<f64>>();
                    let total = list(&totals[i].0);
                    let (body_point, direction) = if by_direction {
                        (total, list(&part.direction))
                    } else {
                        (list(&part.point), total)
                    };
                    let sum = Uniform { weight: 1.0, body_point, direction };
                    self.stands(at[k], PotentialTerm::Uniform(sum));
                }
                None if !into.is_empty() => {
                    self.merge(at[k], &into, if part.constant == 0.0 { UNIFORM } else { SPRING });
                }
                _ => {
                    let others = by.iter().flat_map(|&i| basis.shares(i));
                    let with = others.into_iter().find(|&other| other != k).unwrap_or(k);
                    let why = format!("cancels with {}", self.plans[at[with]].pointer);
                    self.leave_out(at[k], why);
                }
            }
        }
    }

    /// Adds sources, and springs, between the same points.
    fn add_equal(&mut self) {
        for first in 0..self.left.len() {
            let Some(term) = self.left[first].clone() else { continue };
            let same = |k: &usize| {
                self.left[*k].as_ref().and_then(|other| equal_strength(&term, other)).is_some()
            };
            let group: Vec<usize> = (first..self.left.len()).filter(same).collect();
            if group.len() < 2 {
                continue;
            }
            let strengths: Vec<DVector<f64>> = group
                .iter()
                .filter_map(|&k| equal_strength(&term, self.left[k].as_ref()?))
                .map(|strength| DVector::repeat(1, strength))
                .collect();
            let (sum, size) = sum(&strengths);
            if sum.amax() <= ROUNDED * size {
                self.cancel(&group);
                continue;
            }
            for &k in &group[1..] {
                self.merge(k, &[first], EQUAL);
            }
            let mut term = term;
            match &mut term {
                PotentialTerm::PointSource(t) => t.strength = sum[0],
                PotentialTerm::Spring(t) => t.stiffness = sum[0],
                _ => {}
            }
            self.stands(first, term);
        }
    }

    /// Leaves out gravity gradients of one matrix that together are the same in every direction.
    fn add_isotropic(&mut self) {
        let mut looked_at = vec![false; self.left.len()];
        for first in 0..self.left.len() {
            let Some(matrix) = self.gradient(first).map(GravityGradient::matrix) else { continue };
            if looked_at[first] {
                continue;
            }
            let entries = matrix.transpose();
            let same = |k: &usize| {
                self.gradient(*k).is_some_and(|t| {
                    let others = t.matrix.iter().flatten().flatten();
                    near(others.copied(), entries.iter().copied())
                })
            };
            let group: Vec<usize> = (first..self.left.len()).filter(same).collect();
            group.iter().for_each(|&k| looked_at[k] = true);
            let n = matrix.nrows();
            let (mut form, mut size) = (DMatrix::zeros(n, n), 0.0);
            for t in group.iter().filter_map(|&k| self.gradient(k)) {
                let d = DVector::from_column_slice(&t.direction);
                form += &d * d.transpose() * t.strength();
                size += t.strength().abs() * d.norm_squared();
            }
            let level = form.trace() / n as f64;
            if group.len() < 2 || (&form - DMatrix::identity(n, n) * level).amax() > ROUNDED * size
            {
                continue;
            }
            self.constant += 0.5 * level * matrix.trace();
            if level.abs() <= ROUNDED * size {
                self.cancel(&group);
                continue;
            }
            let pointers: Vec<String> =
                group.iter().map(|&k| self.plans[k].pointer.clone()).collect();
            let together = pointers.join(", ");
            for &k in &group {
                let why = format!(
                    "is the same at every attitude: {together} pull equally in all directions"
                );
                self.leave_out(k, why);
            }
        }
    }

    /// Adds gravity gradients along one direction.
    fn add_along(&mut self) {
        let along: Vec<Option<DVector<f64>>> = (0..self.left.len())
            .map(|k| Some(unit(&DVector::from_column_slice(&self.gradient(k)?.direction))))
            .collect();
        for first in 0..self.left.len() {
            let Some(term) = self.gradient(first).cloned() else { continue };
            let direction = DVector::from_column_slice(&term.direction);
            let parallel = |k: &usize| match (&along[first], &along[*k]) {
                (Some(u), Some(v)) => [1.0, -1.0]
                    .into_iter()
                    .any(|sign| near(u.iter().copied(), v.iter().map(|x| sign * x))),
                _ => false,
            };
            let group: Vec<usize> = (first..self.left.len())
                .filter(|&k| self.left[k].is_some() && parallel(&k))
                .collect();
            if group.len() < 2 {
                continue;
            }
            let summands: Vec<DMatrix<f64>> = group
                .iter()
                .filter_map(|&k| {
                    let t = self.gradient(k)?;
                    let own = DVector::from_column_slice(&t.direction);
                    let c = own.dot(&direction) / direction.norm_squared();
                    Some(t.matrix() * (t.strength() * c * c))
                })
                .collect();
            let n = direction.len();
            let (matrix, size) = sum(&summands);
            let level = matrix.trace() / n as f64;
            if (&matrix - DMatrix::identity(n, n) * level).amax() <= ROUNDED * size {
                self.constant += 0.5 * level * direction.norm_squared();
                self.cancel(&group);
                continue;
            }
            for &k in &group[1..] {
                self.merge(k, &[first], ALONG);
            }
            let rows = matrix.row_iter().map(|row| row.iter().copied().collect()).collect();
            let matrix = Some(rows);
            let direction = term.direction;
            let together = GravityGradient { strength: Some(1.0), direction, matrix };
            self.stands(first, PotentialTerm::GravityGradient(together));
        }
    }

    fn gradient(&self, index: usize) -> Option<&GravityGradient> {
        match self.left[index].as_ref()? {
            PotentialTerm::GravityGradient(term) => Some(term),
            _ => None,
        }
    }

    /// Leaves out terms whose torque, at its largest and for the whole run, changes the momentum by
    /// less than a part of what changes it anyway and turns the body by less than can be seen: `w
    /// tau T^2 <= 1e-16`.
    fn leave_out_unseen(&mut self, extent: &Extent, model: &Model) {
        let Extent { duration_s, momentum, mobility } = *extent;
        let torque = |term: &PotentialTerm| term.law().largest_torque();
        let torques: Vec<f64> =
            self.left.iter().map(|term| term.as_ref().map_or(f64::NAN, torque)).collect();
        let largest = torques.iter().copied().filter(|x| x.is_finite()).fold(0.0, f64::max);
        // The limit is for all of them together.
        let unseen = UNSEEN / torques.len().max(1) as f64;
        for (index, torque) in torques.into_iter().enumerate() {
            let impulse = torque * duration_s;
            if impulse <= unseen * (momentum + largest * duration_s)
                && mobility * impulse * duration_s <= unseen
                && let Some(term) = &self.left[index]
            {
                self.constant += model.value_at_start(term);
                let why = "moves the body by less than rounding does in the whole run";
                self.leave_out(index, why.to_owned());
            }
        }
    }
}

/// `weight direction . (g point)`, and a constant.
struct Linear {
    weight: f64,
    direction: DVector<f64>,
    point: DVector<f64>,
    constant: f64,
}

impl Linear {
    /// Returns the term in this form, if it has one.
    fn of(term: &PotentialTerm) -> Option<Self> {
        let vector = |v: &[f64]| DVector::from_column_slice(v);
        match term {
            PotentialTerm::Uniform(t) => Some(Self {
                weight: t.weight,
                direction: vector(&t.direction),
                point: vector(&t.body_point),
                constant: 0.0,
            }),
            PotentialTerm::Spring(t) if t.rest_length == 0.0 => {
                let (direction, point) = (vector(&t.position), vector(&t.body_point));
                let constant =
                    0.5 * t.stiffness * (direction.norm_squared() + point.norm_squared());
                Some(Self { weight: -t.stiffness, direction, point, constant })
            }
            _ => None,
        }
    }
}

/// Independent vectors among some, and all of them by these: `v_k = sum_i c_ki v_(member i)`.
struct Basis {
    members: Vec<usize>,
    coordinates: Vec<Vec<f64>>,
}

impl Basis {
    /// Returns the numbers of the vectors that have a part of the member `i`.
    fn shares(&self, i: usize) -> impl Iterator<Item = usize> {
        (0..self.coordinates.len()).filter(move |&k| self.coordinates[k][i] != 0.0)
    }

    /// Returns the members of which the vector `k` has a part.
    fn vectors_of(&self, k: usize) -> impl Iterator<Item = usize> {
        (0..self.members.len()).filter(move |&i| self.coordinates[k][i] != 0.0)
    }

    /// Finds a basis by Gram and Schmidt, twice for round-off, with the first of the vectors of
    /// which much is left.
    fn of<'a>(vectors: impl Iterator<Item = &'a DVector<f64>>) -> Self {
        let vectors: Vec<&DVector<f64>> = vectors.collect();
        let units: Vec<DVector<f64>> = vectors.iter().map(|v| unit(v)).collect();
        let (mut rests, mut members) = (units.clone(), Vec::new());
        let mut frame: Vec<DVector<f64>> = Vec::new();
        loop {
            let sizes: Vec<f64> = rests.iter().map(|rest| rest.norm()).collect();
            let most = sizes.iter().copied().fold(0.0, f64::max);
            if !(most > ROUNDED) {
                break;
            }
            let next = sizes.iter().position(|&size| size >= 0.5 * most).unwrap_or(0);
            frame.push(&rests[next] / sizes[next]);
            members.push(next);
            for (rest, v) in rests.iter_mut().zip(&units) {
                *rest = v.clone();
                for axis in frame.iter().chain(&frame) {
                    let part = axis.dot(rest);
                    rest.axpy(-part, axis, 1.0);
                }
            }
        }
        // The members in the frame: upper triangular.
        let rank = members.len();
        let triangle = DMatrix::from_fn(rank, rank, |i, j| {
            if i <= j { frame[i].dot(vectors[members[j]]) } else { 0.0 }
        });
        let of_member = |i: usize, c: f64| {
            let mut coordinates = vec![0.0; rank];
            coordinates[i] = c;
            coordinates
        };
        let coordinates = vectors.iter().enumerate().map(|(k, v)| {
            if let Some(i) = members.iter().position(|&member| member == k) {
                return of_member(i, 1.0);
            }
            let parallel = |i: usize| Some((i, multiple(v, vectors[members[i]])?));
            if let Some((i, c)) = (0..rank).find_map(parallel) {
                return of_member(i, c);
            }
            let seen = DVector::from_iterator(rank, frame.iter().map(|axis| axis.dot(v)));
            let c = triangle.solve_upper_triangular(&seen).unwrap_or(seen);
            let small = |i: usize| (c[i] * vectors[members[i]]).amax() <= ROUNDED * v.amax();
            (0..rank).map(|i| if small(i) { 0.0 } else { c[i] }).collect()
        });
        let coordinates = coordinates.collect();
        Self { members, coordinates }
    }
}

/// Returns `v / |v|`, whose square may be too small for a number; zero for zero.
pub(super) fn unit(v: &DVector<f64>) -> DVector<f64> {
    let size = v.amax();
    if size == 0.0 {
        return v.clone();
    }
    (v / size).normalize()
}

/// Returns `c` where `v = c u` to rounding.
fn multiple(v: &DVector<f64>, u: &DVector<f64>) -> Option<f64> {
    let scale = u.amax();
    let (v, u) = (v / scale, u / scale);
    let c = v.dot(&u) / u.norm_squared();
    ((&v - &u * c).amax() <= ROUNDED * v.amax() && c.is_finite()).then_some(c)
}

/// Returns the sum, by two-sums, and the sum of the sizes.
fn sum<C: Dim>(summands: &[OMatrix<f64, Dyn, C>]) -> (OMatrix<f64, Dyn, C>, f64)
where
    DefaultAllocator: Allocator<Dyn, C>,
{
    let mut total = &summands[0] * 0.0;
    let (mut carry, mut size) = (total.clone(), 0.0);
    for summand in summands {
        size += summand.amax();
        for i in 0..total.len() {
            let (sum, left) = two_sum(total[i], summand[i]);
            (total[i], carry[i]) = (sum, carry[i] + left);
        }
    }
    (total + carry, size)
}

/// Returns whether these are the same numbers, but for rounding of the largest.
fn near(v: impl Iterator<Item = f64> + Clone, u: impl Iterator<Item = f64> + Clone) -> bool {
    let size = u.clone().fold(0.0, |size: f64, x| size.max(x.abs()));
    v.zip(u).all(|(v, u)| (v - u).abs() <= ROUNDED * size)
}

/// Returns the strength of `other` if it is the law of `term` between the same points.
fn equal_strength(term: &PotentialTerm, other: &PotentialTerm) -> Option<f64> {
    let same = |v: &[f64], u: &[f64]| near(v.iter().copied(), u.iter().copied());
    match term {
        PotentialTerm::PointSource(t) => {
            let PotentialTerm::PointSource(o) = other else { return None };
            (same(&t.body_point, &o.body_point) && same(&t.position, &o.position))
                .then_some(o.strength)
        }
        PotentialTerm::Spring(t) => {
            let PotentialTerm::Spring(o) = other else { return None };
            (t.rest_length > 0.0
                && same(&[t.rest_length], &[o.rest_length])
                && same(&t.body_point, &o.body_point)
                && same(&t.position, &o.position))
            .then_some(o.stiffness)
        }
        _ => None,
    }
}
