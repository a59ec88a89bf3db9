//! Several bodies in one space: each turns, free ones move, joints hold them together, potentials couple them.
//!
//! Body a has an attitude `g_a` in SO(n) and a body momentum `mu_a`. Bodies that joints hold together are a tree, and have a
//! place in common: a fixed point, or their centre of mass, which moves with a momentum of its own. The centre of mass of
//! body a (of a pinned body: its pivot) is at
//!
//! ```text
//! r_a = x + sum_b g_b l_ab                                                                              [place]
//! ```
//!
//! x the place of its tree and `l_ab` constant vectors of the bodies b: joint points coincide by construction. A body without
//! joints is a tree of its own, and its only lever is zero. With `D_bc = sum_a m_a l_ab l_ac^T` the kinetic energy is
//!
//! ```text
//! T = |p|^2 / (2 M) + 1/2 sum_a <J_a Omega_a, Omega_a> + 1/2 sum_bc tr((g_b Omega_b)^T (g_c Omega_c) D_cb)   [kinetic]
//! ```
//!
//! because levers are taken from the centre of mass, so that `sum_a m_a l_ab = 0` where the place is free. A force F on a
//! point of body a at `g_a y` from its centre turns the bodies, in space coordinates, by
//!
//! ```text
//! F wedge (g_a y)  of a,      F wedge (g_b l_ab)  of each b,      a wedge b = a b^T - b a^T            [torque]
//! ```
//!
//! Invariant: forces between bodies come in pairs of opposite sign, to the bit, so the linear momentum is kept to rounding.

use nalgebra::{DMatrix, DVector};

use crate::failure::Failure;
use crate::so::{self, Mat, Vector};
use crate::work::Work;

pub mod apart;
pub mod explicit;
pub mod splitting;
pub mod trajectory;
pub mod vpd;
pub mod vpd_adaptive;

mod block;
mod coefficients;
mod forces;
mod motion;
mod rescaled;
mod stop;

use forces::{Configuration, Forces};
pub use motion::{BodiesState, Change, Start};
pub use rescaled::BodiesTimeScale;
pub use stop::{BodiesCondition, BodiesStop, distance};

/// Distance of two points between which a force without a limit acts, in metres, below which it means nothing.
pub const CLOSEST_APPROACH_M: f64 = 1e-8;

/// One body.
#[derive(Clone, Debug, PartialEq)]
pub struct Body<const N: usize> {
    /// The second moments `sum m y y^T` about the centre of mass, about the pivot for a pinned body, in kg m^2: symmetric, in
    /// body coordinates. The inertia is `J(Omega) = D Omega + Omega D`.
    pub second_moments: Mat<N>,
    /// Mass in kg; of no effect for a pinned body.
    pub mass_kg: f64,
    /// What holds it.
    pub hold: Hold<N>,
}

/// What holds a body.
#[derive(Clone, Debug, PartialEq)]
pub enum Hold<const N: usize> {
    /// Nothing: it moves freely.
    Free,
    /// The origin of its coordinates stays at this point of space, in metres.
    Pivot(Vector<N>),
    /// A ball joint: its point `own_point` stays at `parent_point`.
    Joint {
        /// The number of a body; `None` for space.
        parent: Option<usize>,
        /// In coordinates of the parent, or of space.
        parent_point: Vector<N>,
        /// In coordinates of the body.
        own_point: Vector<N>,
    },
}

/// A point of a body, in its coordinates; or of space.
#[derive(Clone, Debug, PartialEq)]
pub enum Site<const N: usize> {
    /// Of a body, by number: from its centre of mass, from the pivot of a pinned one.
    Body(usize, Vector<N>),
    /// Fixed in space.
    Space(Vector<N>),
}

/// A part of the potential.
#[derive(Clone, Debug, PartialEq)]
pub enum Interaction<const N: usize> {
    /// `weight v . r`, r the place of a point of a body.
    Uniform {
        /// Body and point.
        body: usize,
        /// In body coordinates.
        point: Vector<N>,
        /// Weight.
        weight: f64,
        /// v, in space coordinates.
        direction: Vector<N>,
    },
    /// `stiffness / 2 (d - rest_length)^2`, d the distance of two sites.
    Spring {
        /// Between what.
        sites: [Site<N>; 2],
        /// Stiffness in N/m.
        stiffness: f64,
        /// Length at rest in m.
        rest_length: f64,
    },
    /// `strength / d`, d the distance of two sites.
    PointSource {
        /// Between what.
        sites: [Site<N>; 2],
        /// Strength in J m; positive repels.
        strength: f64,
    },
    /// `strength / 2 q . M q`, `q = g^T v`.
    GravityGradient {
        /// The body.
        body: usize,
        /// Strength.
        strength: f64,
        /// M, symmetric, in body coordinates.
        matrix: Mat<N>,
        /// v, in space coordinates.
        direction: Vector<N>,
    },
    /// Gravity between two bodies, to the second degree of both (MacCullagh 1844): with u the unit vector from one centre to
    /// the other and d their distance
    /// `-G m1 m2 / d - G / (2 d^3) (m2 (tr J1 - 3 u . J1 u) + m1 (tr J2 - 3 u . J2 u))`, for n = 3.
    MutualGravity {
        /// The two bodies.
        bodies: [usize; 2],
        /// G in m^3 / (kg s^2).
        constant: f64,
    },
}

/// Why bodies make no system.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum BodiesError {
    /// The second moments of a body are not those of an inertia: sums of two must be above zero.
    #[error("body {0}: an inertia is positive, and its second moments are finite and symmetric")]
    Inertia(usize),
    /// A body that is not pinned has no mass.
    #[error("body {0}: a body that is not pinned has a mass above 0")]
    Mass(usize),
    /// Joints that close a loop, or a parent that there is not.
    #[error("body {0}: joints make trees, and their parents are among the bodies")]
    Parent(usize),
    /// A number of a body that there is not.
    #[error("interaction {0} names a body that there is not")]
    Unknown(usize),
    /// Vectors and numbers that are not finite.
    #[error("a number is not finite")]
    NotFinite,
}

/// The velocity of a body from its momentum.
#[derive(Clone, Debug, PartialEq)]
enum Inverse<const N: usize> {
    /// `Omega_ij = w_ij mu_ij`, in principal axes.
    Weights(Mat<N>),
    /// Through the inverse of J on the coordinates of so(n).
    Full(DMatrix<f64>),
}

/// Bodies that joints hold together; most often one.
#[derive(Clone, Debug)]
struct Tree<const N: usize> {
    /// Mass of all, of which the place is the centre; `None` where the place is fixed.
    mass_kg: Option<f64>,
    /// Its bodies, each after its parent.
    bodies: Vec<usize>,
    /// `l_ab` for the a-th and the b-th of them; empty where all are zero.
    levers: Vec<Vec<Vector<N>>>,
    /// `D_bc`; empty likewise.
    coupling: Vec<Vec<Mat<N>>>,
}

impl<const N: usize> Tree<N> {
    fn is_jointed(&self) -> bool {
        !self.levers.is_empty()
    }
}

/// A system of bodies.
#[derive(Clone, Debug)]
pub struct Bodies<const N: usize> {
    bodies: Vec<Body<N>>,
    inverses: Vec<Inverse<N>>,
    trees: Vec<Tree<N>>,
    /// The tree of each body, and its number there.
    tree_of: Vec<(usize, usize)>,
    /// Places of the trees that are fixed; zero for the others.
    fixed: Vec<Vector<N>>,
    interactions: Vec<Interaction<N>>,
    stops: Vec<BodiesStop<N>>,
    work: Work,
}

impl<const N: usize> Bodies<N> {
    /// Creates the system of `bodies` under `interactions`.
    ///
    /// # Errors
    /// [`BodiesError`].
    pub fn new(
        bodies: Vec<Body<N>>,
        interactions: Vec<Interaction<N>>,
    ) -> Result<Self, BodiesError> {
        let mut inverses = Vec::with_capacity(bodies.len());
        for (a, body) in bodies.iter().enumerate() {
            inverses.push(inverse(&body.second_moments).ok_or(BodiesError::Inertia(a))?);
            let is_pinned = matches!(body.hold, Hold::Pivot(_));
            let has_mass = body.mass_kg > 0.0 && body.mass_kg.is_finite();
            if !is_pinned && !has_mass {
                return Err(BodiesError::Mass(a));
            }
            let points = match &body.hold {
                Hold::Joint { parent_point, own_point, .. } => {
                    [Some(parent_point), Some(own_point)]
                }
                Hold::Pivot(point) => [Some(point), None],
                Hold::Free => [None, None],
            };
            if points.into_iter().flatten().flatten().any(|x| !x.is_finite()) {
                return Err(BodiesError::NotFinite);
            }
        }
        let (members, tree_of) = trees(&bodies)?;
        for (index, interaction) in interactions.iter().enumerate() {
            if interaction.bodies().any(|a| a >= bodies.len()) {
                return Err(BodiesError::Unknown(index));
            }
        }
        let mut fixed = Vec::with_capacity(members.len());
        let trees = members
            .into_iter()
            .map(|members| {
                let (tree, place) = tree(&bodies, members);
                fixed.push(place);
                tree
            })
            .collect();
        let (stops, work) = (Vec::new(), Work::default());
        Ok(Self { bodies, inverses, trees, tree_of, fixed, interactions, stops, work })
    }

    /// Returns the same system, which counts its work there, and ends where that says.
    pub fn watched(self, work: Work) -> Self {
        Self { work, ..self }
    }

    /// The work done so far.
    pub fn work(&self) -> &Work {
        &self.work
    }

    /// The bodies.
    pub fn bodies(&self) -> &[Body<N>] {
        &self.bodies
    }

    /// Number of places: one for each tree.
    pub fn places(&self) -> usize {
        self.trees.len()
    }

    pub(super) fn mass_of_place(&self, place: usize) -> Option<f64> {
        self.trees[place].mass_kg
    }

    /// Do joints couple the velocities of a body to those of others?
    pub(super) fn has_joints(&self) -> bool {
        self.trees.iter().any(Tree::is_jointed)
    }

    /// The weights of `Omega_ij = w_ij mu_ij`; `None` for a body to which that does not apply.
    pub(super) fn weights(&self, body: usize) -> Option<&Mat<N>> {
        let (tree, _) = self.tree_of[body];
        match &self.inverses[body] {
            Inverse::Weights(weights) if !self.trees[tree].is_jointed() => Some(weights),
            _ => None,
        }
    }

    /// [place] of every body.
    fn centres(&self, attitudes: &[Mat<N>], places: &[Vector<N>], centres: &mut [Vector<N>]) {
        for (a, &(tree, own)) in self.tree_of.iter().enumerate() {
            let mut at = places[tree];
            if let Some(levers) = self.trees[tree].levers.get(own) {
                for (lever, &b) in levers.iter().zip(&self.trees[tree].bodies) {
                    at += so::to_space(&attitudes[b], lever);
                }
            }
            centres[a] = at;
        }
    }

    /// Computes the velocities of all bodies from their momenta.
    ///
    /// # Errors
    /// Where the kinetic energy of a tree is not positive, to rounding.
    pub(super) fn velocities(
        &self,
        attitudes: &[Mat<N>],
        momenta: &[Mat<N>],
        velocities: &mut [Mat<N>],
    ) -> Result<(), Failure> {
        for (a, momentum) in momenta.iter().enumerate() {
            velocities[a] = self.velocity_alone(a, momentum);
        }
        let mut room = Vec::new();
        for tree in self.trees.iter().filter(|tree| tree.is_jointed()) {
            let d = so::dimension(N);
            let size = d * tree.bodies.len();
            room.resize(size * (size + 1), 0.0);
            let (mass, right) = room.split_at_mut(size * size);
            self.mass_matrix(tree, attitudes, mass);
            for (right, &body) in right.chunks_exact_mut(d).zip(&tree.bodies) {
                for (right, (i, j)) in right.iter_mut().zip(entries::<N>()) {
                    *right = momenta[body][(i, j)];
                }
            }
            solve_by_cholesky(size, mass, right).ok_or(Failure::not_finite(None))?;
            for (solved, &body) in right.chunks_exact(d).zip(&tree.bodies) {
                velocities[body] = of_coordinates(solved);
            }
        }
        Ok(())
    }

    /// `J^-1 mu` of a body by itself: its velocity, if no joint couples that to those of others.
    fn velocity_alone(&self, body: usize, momentum: &Mat<N>) -> Mat<N> {
        match &self.inverses[body] {
            Inverse::Weights(weights) => momentum.component_mul(weights),
            Inverse::Full(inverse) => {
                let momentum = DVector::from_iterator(so::dimension(N), coordinates(momentum));
                of_coordinates((inverse * momentum).as_slice())
            }
        }
    }

    /// Returns the momenta of bodies that turn at these velocities.
    pub fn momenta(&self, attitudes: &[Mat<N>], velocities: &[Mat<N>]) -> Vec<Mat<N>> {
        let mut momenta: Vec<Mat<N>> = velocities
            .iter()
            .zip(&self.bodies)
            .map(|(omega, body)| body.second_moments * omega + omega * body.second_moments)
            .collect();
        for tree in self.trees.iter().filter(|tree| tree.is_jointed()) {
            let d = so::dimension(N);
            let size = d * tree.bodies.len();
            let mut mass = vec![0.0; size * size];
            self.mass_matrix(tree, attitudes, &mut mass);
            let all: Vec<f64> =
                tree.bodies.iter().flat_map(|&body| coordinates(&velocities[body])).collect();
            // Of the symmetric matrix only rows up to the diagonal are there.
            let entry = |p: usize, q: usize| mass[p.max(q) * size + p.min(q)];
            let row = |p: usize| (0..size).map(|q| entry(p, q) * all[q]).sum();
            let all: Vec<f64> = (0..size).map(row).collect();
            for (own, &body) in all.chunks_exact(d).zip(&tree.bodies) {
                momenta[body] = of_coordinates(own);
            }
        }
        momenta
    }

    /// The matrix of [kinetic] in the coordinates of the velocities: for bodies b and c and entries (i, j) and (k, l), with
    /// `R = g_b^T g_c` and `D = D_cb`, to which the second moments are added where b = c,
    /// `R_ik D_lj - R_il D_kj - R_jk D_li + R_jl D_ki`.
    /// Row by row, up to the diagonal.
    fn mass_matrix(&self, tree: &Tree<N>, attitudes: &[Mat<N>], mass: &mut [f64]) {
        let d = so::dimension(N);
        let size = d * tree.bodies.len();
        for (b, &body_b) in tree.bodies.iter().enumerate() {
            for (c, &body_c) in tree.bodies.iter().enumerate().take(b + 1) {
                let mut weight = tree.coupling[c][b];
                let mut turn = Mat::identity();
                if b == c {
                    weight += self.bodies[body_b].second_moments;
                } else {
                    turn = so::transposed_product(&attitudes[body_b], &attitudes[body_c]);
                }
                let mut p = b * d;
                for i in 0..N {
                    for j in i + 1..N {
                        let row = &mut mass[p * size + c * d..p * size + c * d + d];
                        let mut q = 0;
                        for k in 0..N {
                            for l in k + 1..N {
                                row[q] = turn[(i, k)] * weight[(l, j)]
                                    - turn[(i, l)] * weight[(k, j)]
                                    - turn[(j, k)] * weight[(l, i)]
                                    + turn[(j, l)] * weight[(k, i)];
                                q += 1;
                            }
                        }
                        p += 1;
                    }
                }
            }
        }
    }

    /// The space vectors on which the potential and the fixed places depend: rotations of everything that leave them alone
    /// leave the energy alone.
    pub(super) fn space_vectors(&self) -> Vec<Vector<N>> {
        let mut vectors: Vec<Vector<N>> =
            self.fixed.iter().copied().filter(|v| v.iter().any(|x| *x != 0.0)).collect();
        for interaction in &self.interactions {
            match interaction {
                Interaction::Uniform { direction, .. }
                | Interaction::GravityGradient { direction, .. } => vectors.push(*direction),
                Interaction::Spring { sites, .. } | Interaction::PointSource { sites, .. } => {
                    for site in sites {
                        if let Site::Space(point) = site {
                            vectors.push(*point);
                        }
                    }
                }
                Interaction::MutualGravity { .. } => {}
            }
        }
        vectors
    }
}

impl<const N: usize> Interaction<N> {
    /// The bodies that it acts on.
    pub fn bodies(&self) -> impl Iterator<Item = usize> {
        let of_site = |site: &Site<N>| match site {
            Site::Body(a, _) => Some(*a),
            Site::Space(_) => None,
        };
        let [one, other] = match self {
            Self::Uniform { body, .. } | Self::GravityGradient { body, .. } => [Some(*body), None],
            Self::Spring { sites: [one, other], .. }
            | Self::PointSource { sites: [one, other], .. } => [of_site(one), of_site(other)],
            Self::MutualGravity { bodies: [one, other], .. } => [Some(*one), Some(*other)],
        };
        one.into_iter().chain(other)
    }
}

/// The entries of a skew matrix above its diagonal.
fn entries<const N: usize>() -> impl Iterator<Item = (usize, usize)> {
    (0..N).flat_map(|i| (i + 1..N).map(move |j| (i, j)))
}

/// The entries of a skew matrix: its coordinates here.
fn coordinates<const N: usize>(x: &Mat<N>) -> impl Iterator<Item = f64> {
    entries::<N>().map(|at| x[at])
}

/// Solves `M x = b` for a symmetric positive definite matrix, given row by row up to its diagonal, which is overwritten by its
/// factor; b becomes x. `None` if it is not positive. Kept here, and in place: it is done at each stage of each sweep.
fn solve_by_cholesky(size: usize, mass: &mut [f64], right: &mut [f64]) -> Option<()> {
    for p in 0..size {
        let (above, row) = mass.split_at_mut(p * size);
        for q in 0..p {
            let other = &above[q * size..q * size + q + 1];
            let mut sum = row[q];
            for k in 0..q {
                sum -= row[k] * other[k];
            }
            // The diagonal of the factor is stored inverted.
            row[q] = sum * other[q];
        }
        let mut square = row[p];
        for k in 0..p {
            square -= row[k] * row[k];
        }
        if !(square > 0.0) {
            return None;
        }
        row[p] = 1.0 / square.sqrt();
        let mut sum = right[p];
        for k in 0..p {
            sum -= row[k] * right[k];
        }
        right[p] = sum * row[p];
    }
    for p in (0..size).rev() {
        right[p] *= mass[p * size + p];
        let solved = right[p];
        for k in 0..p {
            right[k] -= mass[p * size + k] * solved;
        }
    }
    Some(())
}

/// The skew matrix of such coordinates.
fn of_coordinates<const N: usize>(x: &[f64]) -> Mat<N> {
    let mut matrix = Mat::zeros();
    for (x, (i, j)) in x.iter().zip(entries::<N>()) {
        matrix[(i, j)] = *x;
        matrix[(j, i)] = -x;
    }
    matrix
}

/// The inverse of an inertia; `None` if it is not positive.
fn inverse<const N: usize>(second_moments: &Mat<N>) -> Option<Inverse<N>> {
    let finite = second_moments.iter().all(|x| x.is_finite());
    let symmetric = (second_moments - second_moments.transpose()).amax() == 0.0;
    if !finite || !symmetric {
        return None;
    }
    let is_principal = entries::<N>().all(|at| second_moments[at] == 0.0);
    if is_principal {
        let sum = |(i, j): (usize, usize)| second_moments[(i, i)] + second_moments[(j, j)];
        if entries::<N>().any(|at| !(sum(at) > 0.0)) {
            return None;
        }
        let weight = |i, j| if i == j { 0.0 } else { 1.0 / sum((i, j)) };
        return Some(Inverse::Weights(Mat::from_fn(weight)));
    }
    let d = so::dimension(N);
    let mut inertia = DMatrix::zeros(d, d);
    for (q, at) in entries::<N>().enumerate() {
        let mut unit = Mat::<N>::zeros();
        unit[at] = 1.0;
        unit[(at.1, at.0)] = -1.0;
        let turned = second_moments * unit + unit * second_moments;
        for (entry, x) in inertia.column_mut(q).iter_mut().zip(coordinates(&turned)) {
            *entry = x;
        }
    }
    inertia.cholesky().map(|factor| Inverse::Full(factor.inverse()))
}

/// The bodies of each tree, each after its parent; and for each body the number of its tree and its own number there.
#[allow(clippy::type_complexity, reason = "read once")]
fn trees<const N: usize>(
    bodies: &[Body<N>],
) -> Result<(Vec<Vec<usize>>, Vec<(usize, usize)>), BodiesError> {
    let mut trees: Vec<Vec<usize>> = Vec::new();
    let mut tree_of: Vec<Option<(usize, usize)>> = vec![None; bodies.len()];
    loop {
        let mut is_over = true;
        for (a, body) in
            bodies.iter().enumerate().filter(|(a, _)| tree_of[*a].is_none()).collect::<Vec<_>>()
        {
            let parent = match body.hold {
                Hold::Joint { parent: Some(parent), .. } => match tree_of.get(parent) {
                    Some(Some((tree, _))) => Some(*tree),
                    _ => continue,
                },
                _ => None,
            };
            let tree = parent.unwrap_or_else(|| {
                trees.push(Vec::new());
                trees.len() - 1
            });
            tree_of[a] = Some((tree, trees[tree].len()));
            trees[tree].push(a);
            is_over = false;
        }
        if is_over {
            break;
        }
    }
    let found = tree_of.iter().enumerate();
    let tree_of =
        found.map(|(a, tree)| tree.ok_or(BodiesError::Parent(a))).collect::<Result<_, _>>()?;
    Ok((trees, tree_of))
}

/// The tree of some bodies, and its place if that is fixed.
fn tree<const N: usize>(bodies: &[Body<N>], members: Vec<usize>) -> (Tree<N>, Vector<N>) {
    let count = members.len();
    let number = |body: usize| members.iter().position(|&member| member == body);
    // l_ab of the path from the root, which later changes for a free root.
    let mut levers = vec![vec![Vector::zeros(); count]; count];
    let mut place = Vector::zeros();
    for (a, &body) in members.iter().enumerate() {
        match &bodies[body].hold {
            Hold::Free => {}
            Hold::Pivot(point) => place = *point,
            Hold::Joint { parent, parent_point, own_point } => {
                match parent.and_then(number) {
                    Some(parent) => {
                        levers[a] = levers[parent].clone();
                        levers[a][parent] += parent_point;
                    }
                    None => place = *parent_point,
                }
                levers[a][a] -= own_point;
            }
        }
    }
    let is_free = matches!(bodies[members[0]].hold, Hold::Free);
    let mass = |a: usize| match bodies[members[a]].hold {
        // It does not move.
        Hold::Pivot(_) => 0.0,
        _ => bodies[members[a]].mass_kg,
    };
    let total: f64 = (0..count).map(mass).sum();
    if is_free {
        for b in 0..count {
            let mean = (0..count).map(|a| levers[a][b] * mass(a)).sum::<Vector<N>>() / total;
            levers.iter_mut().for_each(|levers| levers[b] -= mean);
        }
    }
    let mass_kg = is_free.then_some(total);
    if levers.iter().flatten().all(|lever| lever.iter().all(|x| *x == 0.0)) {
        let none = (Vec::new(), Vec::new());
        return (Tree { mass_kg, bodies: members, levers: none.0, coupling: none.1 }, place);
    }
    let coupling = |b: usize, c: usize| {
        (0..count).map(|a| levers[a][b] * levers[a][c].transpose() * mass(a)).sum::<Mat<N>>()
    };
    let coupling = (0..count).map(|b| (0..count).map(|c| coupling(b, c)).collect()).collect();
    (Tree { mass_kg, bodies: members, levers, coupling }, place)
}
