//! Bodies whose time is rescaled where points of theirs come close: steps of one length in a time tau, with
//! `dt = sigma dtau`, as [`crate::hamiltonian::Rescaled`] for one body. With q all attitudes and places, p all momenta,
//!
//! ```text
//! H~(q, p) = sigma(q) (H(q, p) - H0)        sigma = S^(-1/2)        S = 1 + sum (near / rho)^3
//! dH~/dp = sigma dH/dp        -dH~/dq = sigma F - (H - H0) sigma^3 / 2 F_S        F = -dH/dq,   F_S = -dS/dq      [rescaled]
//! ```
//!
//! (Poincaré's transformation: Hairer 1997, Applied Numerical Mathematics 25; Reich 1999, SIAM J. Numer. Anal. 36). rho are the
//! distances of the point sources and of the centres under mutual gravity; H0 is the energy at the start.
//!
//! Invariant: sigma is a function of distances, so forces by it come in pairs, too, to the bit: momenta are kept as without it.

use super::forces::{arm_of, distance};
use super::trajectory::BodySample;
use super::{Bodies, BodiesState, Configuration, Forces, Interaction, Site};
use crate::failure::Failure;
use crate::lanes::Real;
use crate::so::{self, Mat, Vector};

/// sigma, a function of the distances of pairs of points.
#[derive(Clone, Debug, PartialEq)]
pub struct BodiesTimeScale {
    near_m: Vec<f64>,
}

impl BodiesTimeScale {
    /// Creates a time scale from a length for each interaction, in m, below which time slows down; 0 for one that time does
    /// not look at. Only point sources and mutual gravity are looked at.
    pub fn new(near_m: Vec<f64>) -> Self {
        Self { near_m }
    }

    /// Returns the time scale of bodies that begin at `state`, with a length for each point source and mutual gravity: the
    /// distance d of its points; of a pinned body and space, as for one body, that of the point from the pivot. Of points that
    /// attract each other and are bound, half the long axis of the ellipse on which they would move by themselves,
    /// `1 / (2 / d - v^2 / (s (1/m1 + 1/m2)))`, if that is longer, up to a hundred times d: the start may be where they are nearest.
    pub fn of<const N: usize>(bodies: &Bodies<N>, state: &BodiesState<N>) -> Self {
        let seen = bodies.seen(state).unwrap_or_default();
        let near = |interaction: &Interaction<N>| bodies.near_m(interaction, state, &seen);
        Self { near_m: bodies.interactions.iter().map(near).collect() }
    }

    /// The lengths, in m.
    pub fn near_m(&self) -> &[f64] {
        &self.near_m
    }

    /// Returns about how fast everything changes in the time of this scale where it passes slowly, in rad/s: as at the start, and
    /// as at the distances below which it slows down.
    pub fn rate<const N: usize>(&self, bodies: &Bodies<N>, start: &BodiesState<N>) -> f64 {
        let begun = bodies.rate(start);
        let mut square = begun * begun;
        for (interaction, near) in bodies.interactions.iter().zip(&self.near_m) {
            if let Some((_, strength, mobility)) = bodies.pair(interaction)
                && *near > 0.0
            {
                // The second derivative of strength / r.
                square += 2.0 * strength.abs() * mobility / (near * near * near);
            }
        }
        square.sqrt()
    }

    /// sigma of a state, in (0, 1].
    ///
    /// # Errors
    /// Where two points meet.
    pub fn sigma<const N: usize>(
        &self,
        bodies: &Bodies<N>,
        attitudes: &[Mat<N>],
        places: &[Vector<N>],
    ) -> Result<f64, Failure> {
        self.look(bodies, attitudes, places).map(|pairs| pairs.sigma())
    }

    fn look<const N: usize>(
        &self,
        bodies: &Bodies<N>,
        attitudes: &[Mat<N>],
        places: &[Vector<N>],
    ) -> Result<Pairs, Failure> {
        let at = Configuration { attitudes, places, velocities: &[] };
        let mut centres = vec![Vector::zeros(); attitudes.len()];
        bodies.centres(attitudes, places, &mut centres);
        bodies.look_at_pairs(self, at, &centres, None)
    }
}

/// The pairs of a configuration.
#[derive(Clone, Copy, Debug)]
struct Pairs {
    /// S
    sum: f64,
    /// By how much the rounding of places grows in distances: the largest of one and of places in parts of the distance of two.
    magnified: f64,
}

impl Pairs {
    fn sigma(&self) -> f64 {
        1.0 / self.sum.sqrt()
    }
}

/// What a step in a time of its own knows at its stages.
#[derive(Clone, Debug)]
pub(super) struct Rescaling<const N: usize> {
    pub(super) scale: BodiesTimeScale,
    /// H0 in J.
    pub(super) energy: f64,
    /// sigma of each stage.
    pub(super) sigma: Vec<f64>,
    /// The largest of [`Pairs::magnified`] at the stages.
    magnified: f64,
    /// `dH/dmu` of the bodies, one stage after the other, and the kinetic energy in their turning.
    velocities: Vec<Mat<N>>,
    turning: Vec<f64>,
    /// Those of S, at one stage.
    of_sum: Forces<N>,
}

impl<const N: usize> Rescaling<N> {
    pub(super) fn new(
        scale: BodiesTimeScale,
        energy: f64,
        [stages, bodies, trees]: [usize; 3],
    ) -> Self {
        Self {
            scale,
            energy,
            sigma: vec![1.0; stages],
            magnified: 1.0,
            velocities: vec![Mat::zeros(); stages * bodies],
            turning: vec![0.0; stages],
            of_sum: Forces::none(bodies, trees),
        }
    }

    /// Takes note of the velocities at a stage; returns sigma there.
    pub(super) fn note_velocities(
        &mut self,
        stage: usize,
        momenta: &[Mat<N>],
        velocities: &[Mat<N>],
    ) -> f64 {
        let (first, count) = (stage * velocities.len(), velocities.len());
        self.velocities[first..first + count].copy_from_slice(velocities);
        let energy = momenta.iter().zip(velocities).map(|(mu, omega)| 0.5 * so::inner(mu, omega));
        self.turning[stage] = energy.sum();
        self.sigma[stage]
    }

    /// Appends sigma at a stage, seen before any of them is renewed.
    ///
    /// # Errors
    /// Where two points meet.
    pub(super) fn look_at_stage(
        &mut self,
        bodies: &Bodies<N>,
        stage: usize,
        attitudes: &[Mat<N>],
        places: &[Vector<N>],
        renewed: &mut Vec<f64>,
    ) -> Result<(), Failure> {
        let pairs = self.scale.look(bodies, attitudes, places)?;
        self.magnified =
            if stage == 0 { pairs.magnified } else { self.magnified.max(pairs.magnified) };
        renewed.push(pairs.sigma());
        Ok(())
    }

    /// The largest change of sigma since `before`, in parts of it and of what rounding makes of distances.
    pub(super) fn change_since(&self, before: &[f64]) -> f64 {
        let changes =
            self.sigma.iter().zip(before).map(|(now, before)| ((now - before) / now).abs());
        changes.fold(0.0, |most: f64, x| Real::max_or_nan(most, x)) / self.magnified
    }

    /// `dH/dmu` of all bodies at a stage.
    pub(super) fn velocities(&self, stage: usize) -> &[Mat<N>] {
        let count = self.velocities.len() / self.sigma.len();
        &self.velocities[stage * count..(stage + 1) * count]
    }

    /// `dt / dtau` over the step.
    pub(super) fn mean(&self, weights: &[f64]) -> f64 {
        self.sigma.iter().zip(weights).map(|(sigma, weight)| sigma * weight).sum()
    }

    /// [rescaled]: makes of the forces at a stage those of H~, with the kinetic energy of moving there. `sizes` become those of
    /// what was added up to the forces on the trees.
    pub(super) fn rescale(
        &mut self,
        bodies: &Bodies<N>,
        stage: usize,
        at: Configuration<'_, N>,
        moving: f64,
        forces: &mut Forces<N>,
        sizes: &mut [f64],
    ) -> Result<(), Failure> {
        let pairs = bodies.forces_of_sum(&self.scale, at, &mut self.of_sum)?;
        let sigma = pairs.sigma();
        self.sigma[stage] = sigma;
        let potential = bodies.potential(at.attitudes, at.places);
        let kinetic = self.turning[stage] + moving;
        let factor = -0.5 * sigma * sigma * sigma;
        let above = ((kinetic + potential) - self.energy) * factor;
        // H - H0 is a difference of numbers of this size.
        let rounded = (kinetic + potential.abs() + self.energy.abs()) * factor.abs();
        let of_sum = &self.of_sum;
        for (torque, by_sum) in forces.torques.iter_mut().zip(&of_sum.torques) {
            *torque = *torque * sigma + by_sum * above;
        }
        for (size, by_sum) in forces.sizes.iter_mut().zip(&of_sum.sizes) {
            *size = (*size * sigma + by_sum * rounded) * pairs.magnified;
        }
        let on_trees = forces.forces.iter_mut().zip(&of_sum.forces);
        for ((force, by_sum), size) in on_trees.zip(sizes) {
            *size = (force.norm() * sigma + by_sum.norm() * rounded) * pairs.magnified;
            *force = *force * sigma + by_sum * above;
        }
        Ok(())
    }
}

impl<const N: usize> Bodies<N> {
    /// Returns the two sites of an interaction whose distance r steps can adapt to, the strength s of its energy s / r, and the sum of the inverse
    /// masses of what moves.
    fn pair(&self, interaction: &Interaction<N>) -> Option<([Site<N>; 2], f64, f64)> {
        let sites = interaction.close_sites()?;
        let strength = match interaction {
            Interaction::PointSource { strength, .. } => *strength,
            Interaction::MutualGravity { bodies: [one, other], constant } => {
                -constant * self.bodies[*one].mass_kg * self.bodies[*other].mass_kg
            }
            _ => return None,
        };
        let mobility = |site: &Site<N>| match site {
            // A body that is held moves by turning.
            Site::Body(a, point) => match self.trees[self.tree_of[*a].0].mass_kg {
                Some(mass_kg) => 1.0 / mass_kg,
                None => {
                    let arm = so::dot(point.as_slice(), point.as_slice());
                    let least = self.bodies[*a].second_moments.trace();
                    if arm > 0.0 && least > 0.0 { arm / least } else { 0.0 }
                }
            },
            Site::Space(_) => 0.0,
        };
        let mobility = sites.iter().map(mobility).sum();
        Some((sites, strength, mobility))
    }

    /// See [`BodiesTimeScale::of`].
    fn near_m(
        &self,
        interaction: &Interaction<N>,
        state: &BodiesState<N>,
        seen: &[BodySample<N>],
    ) -> f64 {
        /// Part of d beyond which no ellipse counts.
        const MOST: f64 = 100.0;
        let Some((sites, strength, mobility)) = self.pair(interaction) else { return 0.0 };
        let pinned_arm = match &sites {
            [Site::Body(a, point), Site::Space(_)] | [Site::Space(_), Site::Body(a, point)] => {
                self.is_pinned(*a).then(|| point.norm())
            }
            _ => None,
        };
        if let Some(arm) = pinned_arm.filter(|arm| *arm > 0.0) {
            return arm;
        }
        let motion = |site: &Site<N>| match site {
            Site::Body(a, point) => seen.get(*a).map_or_else(
                || (Vector::zeros(), Vector::zeros()),
                |body| {
                    let turning = so::product(&state.attitudes[*a], &body.angular_velocity);
                    let place = body.position + so::to_space(&state.attitudes[*a], point);
                    (place, body.velocity + so::to_space(&turning, point))
                },
            ),
            Site::Space(at) => (*at, Vector::zeros()),
        };
        let [one, other] = sites.each_ref().map(motion);
        let (d, speed) = ((other.0 - one.0).norm(), (other.1 - one.1).norm());
        let inverse = 2.0 / d - speed * speed / (-strength * mobility);
        let is_bound = strength * mobility < 0.0 && inverse > 0.0;
        if is_bound { (1.0 / inverse).max(d).min(MOST * d) } else { d }
    }

    /// Returns S, and computes its forces `-dS/dq`.
    fn forces_of_sum(
        &self,
        scale: &BodiesTimeScale,
        at: Configuration<'_, N>,
        forces: &mut Forces<N>,
    ) -> Result<Pairs, Failure> {
        self.gathered(at, forces, |centres, forces| {
            self.look_at_pairs(scale, at, centres, Some(forces))
        })
    }

    /// Returns S, and adds its forces to those on centres: a pair at the distance rho pushes each other away by
    /// `3 near^3 / rho^4`.
    fn look_at_pairs(
        &self,
        scale: &BodiesTimeScale,
        at: Configuration<'_, N>,
        centres: &[Vector<N>],
        mut forces: Option<&mut Forces<N>>,
    ) -> Result<Pairs, Failure> {
        let mut pairs = Pairs { sum: 1.0, magnified: 1.0 };
        for (interaction, near) in self.interactions.iter().zip(&scale.near_m) {
            let Some(sites) = interaction.close_sites().filter(|_| *near > 0.0) else { continue };
            let [one, other] = sites.each_ref().map(|site| arm_of(site, at.attitudes, centres));
            let apart = other.1 - one.1;
            let rho = distance(&apart)?;
            let part = near / rho;
            let cube = part * part * part;
            pairs.sum += cube;
            pairs.magnified = pairs.magnified.max(one.1.amax().max(other.1.amax()) / rho);
            if let Some(forces) = &mut forces {
                let push = apart * (3.0 * cube / (rho * rho));
                forces.push(&sites[0], &one.0, &-push);
                forces.push(&sites[1], &other.0, &push);
            }
        }
        Ok(pairs)
    }
}

impl<const N: usize> Interaction<N> {
    /// The two sites whose distance steps can adapt to.
    pub(super) fn close_sites(&self) -> Option<[Site<N>; 2]> {
        match self {
            Self::PointSource { sites, .. } => Some(sites.clone()),
            Self::MutualGravity { bodies, .. } => {
                Some(bodies.map(|body| Site::Body(body, Vector::zeros())))
            }
            _ => None,
        }
    }
}
