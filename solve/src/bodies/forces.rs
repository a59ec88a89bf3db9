//! The forces of a configuration, and its potential energy: each law once as a force and once as an energy.
//!
//! Invariant: what two bodies do to each other is added to one and taken from the other, with the same bits.

use super::{Bodies, CLOSEST_APPROACH_M, Interaction, Site, Tree};
use crate::failure::{Failure, FailureCode};
use crate::so::{self, Mat, Vector};

/// A configuration at one instant, as forces see it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Configuration<'a, const N: usize> {
    pub(super) attitudes: &'a [Mat<N>],
    /// Of the trees.
    pub(super) places: &'a [Vector<N>],
    /// `Omega`, of which only bodies in joints make use.
    pub(super) velocities: &'a [Mat<N>],
}

/// Forces at one instant, in space coordinates.
#[derive(Clone, Debug)]
pub(super) struct Forces<const N: usize> {
    /// `-dH/dg` of each body, turned to space.
    pub(super) torques: Vec<Mat<N>>,
    /// `-dH/dx` of each tree.
    pub(super) forces: Vec<Vector<N>>,
    /// Sizes of the torques that were added up, of each body: what rounding is relative to.
    pub(super) sizes: Vec<f64>,
    /// Forces on the centres, of each body.
    on_centres: Vec<Vector<N>>,
    /// `r_a`
    centres: Vec<Vector<N>>,
}

impl<const N: usize> Forces<N> {
    pub(super) fn none(bodies: usize, trees: usize) -> Self {
        Self {
            torques: vec![Mat::zeros(); bodies],
            forces: vec![Vector::zeros(); trees],
            sizes: vec![0.0; bodies],
            on_centres: vec![Vector::zeros(); bodies],
            centres: vec![Vector::zeros(); bodies],
        }
    }

    /// Pushes at a site, at this arm from the centre of its body.
    pub(super) fn push(&mut self, site: &Site<N>, arm: &Vector<N>, force: &Vector<N>) {
        if let Site::Body(a, point) = site {
            self.on_centres[*a] += force;
            if point.iter().any(|x| *x != 0.0) {
                self.twist(*a, force, arm);
            }
        }
    }

    /// Adds the torque `force wedge arm` to a body: here `force arm^T`, of which [`Forces::torques`] is made.
    #[inline]
    fn twist(&mut self, body: usize, force: &Vector<N>, arm: &Vector<N>) {
        let torque = &mut self.torques[body];
        for j in 0..N {
            for i in 0..N {
                torque[(i, j)] += force[i] * arm[j];
            }
        }
        self.sizes[body] += force.amax() * arm.amax();
    }
}

impl<const N: usize> Bodies<N> {
    /// Computes the forces of a configuration.
    ///
    /// # Errors
    /// [`FailureCode::PotentialSingularity`] with the distance.
    pub(super) fn forces(
        &self,
        at: Configuration<'_, N>,
        forces: &mut Forces<N>,
    ) -> Result<(), Failure> {
        self.gathered(at, forces, |centres, forces| self.interact(at, centres, forces))?;
        for tree in self.trees.iter().filter(|tree| tree.is_jointed()) {
            self.inertial_torques(tree, at, forces);
        }
        Ok(())
    }

    /// Gathers what `interact` pushes, on centres and as torques about them: forces on trees, and torques.
    pub(super) fn gathered<T>(
        &self,
        at: Configuration<'_, N>,
        forces: &mut Forces<N>,
        interact: impl FnOnce(&[Vector<N>], &mut Forces<N>) -> Result<T, Failure>,
    ) -> Result<T, Failure> {
        forces.torques.fill(Mat::zeros());
        forces.forces.fill(Vector::zeros());
        forces.on_centres.fill(Vector::zeros());
        forces.sizes.fill(0.0);
        let mut centres = std::mem::take(&mut forces.centres);
        self.centres(at.attitudes, at.places, &mut centres);
        let done = interact(&centres, forces);
        forces.centres = centres;
        let done = done?;
        for (a, &(tree, own)) in self.tree_of.iter().enumerate() {
            let force = forces.on_centres[a];
            forces.forces[tree] += force;
            if let Some(levers) = self.trees[tree].levers.get(own) {
                for (lever, &b) in levers.iter().zip(&self.trees[tree].bodies) {
                    forces.twist(b, &force, &so::to_space(&at.attitudes[b], lever));
                }
            }
        }
        forces.torques.iter_mut().for_each(|torque| *torque = so::asym(torque));
        Ok(done)
    }

    /// Adds up the forces of all interactions, on centres and as torques about them.
    fn interact(
        &self,
        at: Configuration<'_, N>,
        centres: &[Vector<N>],
        forces: &mut Forces<N>,
    ) -> Result<(), Failure> {
        for interaction in &self.interactions {
            match interaction {
                Interaction::Uniform { body, point, weight, direction } => {
                    let arm = so::to_space(&at.attitudes[*body], point);
                    forces.push(&Site::Body(*body, *point), &arm, &(direction * -*weight));
                }
                Interaction::Spring { sites, stiffness, rest_length } => {
                    let one = arm_of(&sites[0], at.attitudes, centres);
                    let other = arm_of(&sites[1], at.attitudes, centres);
                    let apart = other.1 - one.1;
                    let slope = if *rest_length == 0.0 {
                        *stiffness
                    } else {
                        let distance = distance(&apart)?;
                        stiffness * (1.0 - rest_length / distance)
                    };
                    let force = apart * slope;
                    forces.push(&sites[0], &one.0, &force);
                    forces.push(&sites[1], &other.0, &-force);
                }
                Interaction::PointSource { sites, strength } => {
                    let one = arm_of(&sites[0], at.attitudes, centres);
                    let other = arm_of(&sites[1], at.attitudes, centres);
                    let apart = other.1 - one.1;
                    let distance = distance(&apart)?;
                    let force = apart * (-strength / (distance * distance * distance));
                    forces.push(&sites[0], &one.0, &force);
                    forces.push(&sites[1], &other.0, &-force);
                }
                Interaction::GravityGradient { body, strength, matrix, direction } => {
                    let g = &at.attitudes[*body];
                    let q = so::to_body(g, direction);
                    // dU/dq = strength M q; q moves by -xi q as g does by g xi.
                    let slope = so::to_space(g, &(so::to_space(matrix, &q) * *strength));
                    forces.twist(*body, &slope, direction);
                }
                Interaction::MutualGravity { bodies, constant } => {
                    let [one, other] = *bodies;
                    let apart = centres[other] - centres[one];
                    let d = distance(&apart)?;
                    let u = apart / d;
                    let pull = self.gravity(*bodies, *constant, at.attitudes, &u, d);
                    for (a, slope) in pull.slopes {
                        forces.twist(a, &slope, &u);
                    }
                    forces.on_centres[one] += pull.force;
                    forces.on_centres[other] -= pull.force;
                }
            }
        }
        Ok(())
    }

    /// `dT/dg` at constant velocity, turned to space: `asym(sum_c (g_c Omega_c) D_cb (g_b Omega_b)^T)` of body b. What c does
    /// to b, b does to c with the opposite sign.
    fn inertial_torques(&self, tree: &Tree<N>, at: Configuration<'_, N>, forces: &mut Forces<N>) {
        let turning: Vec<Mat<N>> =
            tree.bodies.iter().map(|&a| so::product(&at.attitudes[a], &at.velocities[a])).collect();
        for (b, &body_b) in tree.bodies.iter().enumerate() {
            for (c, &body_c) in tree.bodies.iter().enumerate().take(b) {
                let carried = so::product(&turning[c], &tree.coupling[c][b]);
                let torque = so::asym(&so::product(&carried, &turning[b].transpose()));
                forces.torques[body_b] += torque;
                forces.torques[body_c] -= torque;
                let size = torque.amax();
                forces.sizes[body_b] += size;
                forces.sizes[body_c] += size;
            }
        }
    }

    /// Gravity of two bodies, u the direction from the first to the second and d their distance.
    fn gravity(
        &self,
        [one, other]: [usize; 2],
        constant: f64,
        attitudes: &[Mat<N>],
        u: &Vector<N>,
        d: f64,
    ) -> Pull<N> {
        let masses = [self.bodies[one].mass_kg, self.bodies[other].mass_kg];
        let d4 = (d * d) * (d * d);
        // J = tr(D) 1 - D: tr J - 3 u . J u = 3 u . D u - tr D, u of length one.
        let mut force = u * (constant * masses[0] * masses[1] / (d * d));
        let slopes = [(one, masses[1]), (other, masses[0])].map(|(a, mass)| {
            let moments = &self.bodies[a].second_moments;
            let g = &attitudes[a];
            let q = so::to_body(g, u);
            let seen = so::to_space(moments, &q);
            let along = so::dot(seen.as_slice(), q.as_slice());
            let s = so::to_space(g, &seen);
            let strength = constant * mass / (2.0 * d4);
            // V = -G m / (2 d^3) (3 u . S u - tr D): the force is -dV/dx of the first, at x.
            force += (u * (15.0 * along - 3.0 * moments.trace()) - s * 6.0) * strength;
            // dV/dq = -3 G m / d^3 D q
            let slope = s * (-3.0 * constant * mass / (d * d * d));
            (a, slope)
        });
        Pull { force, slopes }
    }

    /// Returns the potential energy of a configuration, in J.
    pub(super) fn potential(&self, attitudes: &[Mat<N>], places: &[Vector<N>]) -> f64 {
        let mut centres = vec![Vector::zeros(); self.bodies.len()];
        self.centres(attitudes, places, &mut centres);
        let apart = |sites: &[Site<N>; 2]| {
            let [one, other] = [0, 1].map(|i| arm_of(&sites[i], attitudes, &centres).1);
            so::norm((other - one).as_slice())
        };
        let energy = |interaction: &Interaction<N>| match interaction {
            Interaction::Uniform { body, point, weight, direction } => {
                let at = centres[*body] + so::to_space(&attitudes[*body], point);
                weight * direction.dot(&at)
            }
            Interaction::Spring { sites, stiffness, rest_length } => {
                let stretch = apart(sites) - rest_length;
                0.5 * stiffness * stretch * stretch
            }
            Interaction::PointSource { sites, strength } => strength / apart(sites),
            Interaction::GravityGradient { body, strength, matrix, direction } => {
                let q = so::to_body(&attitudes[*body], direction);
                0.5 * strength * q.dot(&so::to_space(matrix, &q))
            }
            Interaction::MutualGravity { bodies: [one, other], constant } => {
                let apart = centres[*other] - centres[*one];
                let d = so::norm(apart.as_slice());
                let shape = |a: usize| {
                    let q = so::to_body(&attitudes[a], &(apart / d));
                    let moments = &self.bodies[a].second_moments;
                    3.0 * q.dot(&so::to_space(moments, &q)) - moments.trace()
                };
                let [m1, m2] = [*one, *other].map(|a| self.bodies[a].mass_kg);
                let second = m2 * shape(*one) + m1 * shape(*other);
                -constant * (m1 * m2 / d + second / (2.0 * d * d * d))
            }
        };
        self.interactions.iter().map(energy).sum()
    }
}

/// Gravity between two bodies.
struct Pull<const N: usize> {
    /// On the first; on the second the opposite.
    force: Vector<N>,
    /// `dV/du` by body, in space coordinates.
    slopes: [(usize, Vector<N>); 2],
}

/// The arm of a site from the centre of its body, in space coordinates, and its place.
#[inline]
pub(super) fn arm_of<const N: usize>(
    site: &Site<N>,
    attitudes: &[Mat<N>],
    centres: &[Vector<N>],
) -> (Vector<N>, Vector<N>) {
    match site {
        Site::Body(a, point) => {
            let arm = so::to_space(&attitudes[*a], point);
            (arm, centres[*a] + arm)
        }
        Site::Space(at) => (Vector::zeros(), *at),
    }
}

/// The length of a vector between two points that must not meet.
pub(super) fn distance<const N: usize>(apart: &Vector<N>) -> Result<f64, Failure> {
    let distance = apart.norm();
    if distance >= CLOSEST_APPROACH_M {
        return Ok(distance);
    }
    let code =
        if distance.is_nan() { FailureCode::NonFinite } else { FailureCode::PotentialSingularity };
    Err(Failure::new(code, None, distance, CLOSEST_APPROACH_M))
}
