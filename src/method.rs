//! The methods: one row each, read by scenario, plan, assembly, studies, choice and charts.
//!
//! A new integrator is its stepper in `solve/stepper`, its line in `solve/stepper.rs`, and its row
//! here: a name, facts, and its parts. The tests below measure its order. One that is tried for an
//! accuracy needs measured costs, too.
//!
//! Invariant: `auto` is a scenario's word; an [`Integrator`] is one that runs.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::solve::ensemble::Members;
use crate::solve::hamiltonian::TimeScale;
use crate::solve::lanes::WIDTH;
use crate::solve::nonlinear::StopRule;
use crate::solve::stepper::Stepper;
use crate::solve::stepper::explicit_so3::{ExplicitEnsemble, ExplicitSo3};
use crate::solve::stepper::lgvi::Lgvi;
use crate::solve::stepper::quaternion_gauss::QuaternionGauss;
use crate::solve::stepper::rk::Rk;
use crate::solve::stepper::rkmk::Rkmk;
use crate::solve::stepper::vpd::Vpd;
use crate::solve::stepper::vpd_adaptive::VpdAdaptive;
use crate::solve::stepper::vpd_lagrangian::VpdLagrangian;
use crate::solve::stepper::vpd_reduced::VpdReduced;
use crate::solve::stepper::vpd_so3::VpdSo3;
use crate::solve::stepper::vpd_so3::ensemble::VpdEnsemble;
use crate::solve::stepper::vrkmk::Vrkmk;
use crate::solve::tableau::Tableau;

macro_rules! names {
    ($($(#[doc = $doc:literal])* $method:ident = $name:tt,)*) => {
        /// The integrators.
        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
        pub enum MethodName {
            /// The plan chooses.
            #[default]
            #[serde(rename = "auto")]
            Auto,
            $($(#[doc = $doc])* #[serde(rename = $name)] $method,)*
        }

        /// An integrator that runs.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
        pub enum Integrator {
            $($(#[doc = $doc])* #[serde(rename = $name)] $method,)*
        }

        impl MethodName {
            /// Returns the integrator that is asked for; `None` if the plan chooses.
            pub fn integrator(self) -> Option<Integrator> {
                match self {
                    Self::Auto => None,
                    $(Self::$method => Some(Integrator::$method),)*
                }
            }
        }

        impl From<Integrator> for MethodName {
            fn from(integrator: Integrator) -> Self {
                match integrator {
                    $(Integrator::$method => Self::$method,)*
                }
            }
        }

        impl Integrator {
            /// All integrators.
            pub const ALL: &[Self] = &[$(Self::$method),*];

            /// Returns the name in a scenario.
            pub fn as_str(self) -> &'static str {
                match self {
                    $(Self::$method => $name,)*
                }
            }
        }
    };
}

names! {
    /// Variational polar decomposition, Hamiltonian form.
    Vpd = "vpd",
    /// Variational polar decomposition, Lagrangian form: the same map, from the Lagrangian.
    VpdLagrangian = "vpd_lagrangian",
    /// Variational polar decomposition, reduced to the momentum: free bodies.
    VpdReduced = "vpd_reduced",
    /// Variational polar decomposition, Hamiltonian form, in steps that shorten near point sources and stay symplectic.
    VpdAdaptive = "vpd_adaptive",
    /// Variational Runge-Kutta-Munthe-Kaas: symplectic, on the group but for what rounding adds up.
    Vrkmk = "vrkmk",
    /// The same, projected to the group after each step.
    VrkmkProjected = "vrkmk_projected",
    /// Explicit Runge-Kutta-Munthe-Kaas: on the group, not symplectic.
    Rkmk = "rkmk",
    /// Explicit Runge-Kutta in n x n matrices: leaves the group.
    Rk = "rk",
    /// The same, projected to the group after each step.
    RkProjected = "rk_projected",
    /// Exact free top and potential kicks, composed; n = 3.
    Splitting = "splitting",
    /// Lie group variational integrator of Lee, Leok and McClamroch, composed; n = 3.
    Lgvi = "lgvi",
    /// Canonical Gauss collocation on unit quaternions; n = 3.
    QuaternionGauss = "quaternion_gauss",
}

impl MethodName {
    /// Returns the name in a scenario.
    pub fn as_str(self) -> &'static str {
        self.integrator().map_or("auto", Integrator::as_str)
    }
}

impl Default for Integrator {
    /// Returns the method for any scene.
    fn default() -> Self {
        Self::Vpd
    }
}

/// Parameter of a method.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Takes {
    /// A tableau without zeros among its b_i.
    Tableau,
    /// A Gauss tableau.
    Gauss,
    /// An explicit tableau.
    Explicit,
    /// An order: it is a composition.
    Order,
}

/// A method's tableau or order, in the lists of studies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Variant {
    Tableau(TableauName),
    Order(u32),
}

/// Properties of a method.
#[derive(Clone, Copy, Debug)]
pub struct Facts {
    /// Parameter that it takes.
    pub takes: Takes,
    /// Whether its energy error stays at a level that the step fixes.
    pub symplectic: bool,
    /// Whether it is for n = 3 alone.
    pub three: bool,
    /// Whether it can run scenes that change with time, and torques that are no potential's.
    pub driven: bool,
    /// Whether it can run bodies with wheels.
    pub wheels: bool,
    /// Whether it is for free bodies alone. Their momentum moves by itself, the attitude only where
    /// it is asked for.
    pub free: bool,
    /// Whether it can fall back on Newton's method.
    pub newton: bool,
    /// Whether a rigid body is computed in lanes of stages for n = 3. More stages than there are lanes are computed as
    /// for general n.
    pub(crate) lanes: bool,
    /// Whether it is computed for n = 2 where the motion stays in a plane.
    pub(crate) plane: bool,
    /// Number of sweeps assumed for a step where none were counted: for n = 3, elsewhere. 1 for a
    /// method without sweeps.
    pub(crate) sweeps: [f64; 2],
    /// Number of its family: methods of one have one colour, and stand together in tables.
    pub(crate) family: usize,
    /// Its lines in charts: few, so that they can be distinguished.
    charted: &'static [Variant],
    /// Its rows in the map of stability, once for each solver if `solvers`.
    mapped: &'static [Variant],
    solvers: bool,
    /// Variants that are tried for an accuracy, and their turn: methods with cheap steps first.
    tried: (u8, &'static [Variant]),
}

/// Parts from which a stepper is made.
#[derive(Clone, Debug)]
pub(crate) struct Parts {
    pub(crate) tableau: Tableau,
    pub(crate) order: u32,
    pub(crate) stop: StopRule,
    pub(crate) carries_attitude: bool,
    /// Rate of time and longest step, for a method with adaptive steps.
    pub(crate) own_steps: Option<(TimeScale, f64)>,
}

impl Integrator {
    /// Returns its row.
    #[rustfmt::skip]
    pub fn facts(self) -> Facts {
        use TableauName::{Gauss1, Gauss2, Gauss3, Gauss4, Gauss6, Gauss8, Rk3, Rk4, Rk8};
        use Variant::{Order as O, Tableau as T};
        const GAUSS: &[Variant] = &[T(Gauss1), T(Gauss2), T(Gauss3), T(Gauss4), T(Gauss6), T(Gauss8)];
        const EXPLICIT: &[Variant] = &[T(Rk3), T(Rk4), T(Rk8)];
        match self {
            Self::Vpd => Facts {
                takes: Takes::Tableau, symplectic: true, three: false, driven: true, wheels: true, free: false, newton: true,
                lanes: true, plane: true, sweeps: [5.0, 5.0], family: 0,
                charted: &[T(Gauss1), T(Gauss2), T(Gauss3), T(Gauss4), T(Gauss8)],
                mapped: &[T(Gauss1), T(Rk3), T(Gauss2), T(Gauss3), T(Gauss4), T(Gauss6), T(Gauss8)], solvers: true,
                tried: (6, GAUSS),
            },
            Self::VpdLagrangian => Facts {
                takes: Takes::Tableau, symplectic: true, three: false, driven: true, wheels: true, free: false, newton: true,
                lanes: false, plane: false, sweeps: [5.0, 5.0], family: 0,
                charted: &[], mapped: &[T(Gauss2)], solvers: false, tried: (0, &[]),
            },
            Self::VpdReduced => Facts {
                takes: Takes::Tableau, symplectic: true, three: false, driven: false, wheels: true, free: true, newton: true,
                lanes: true, plane: false, sweeps: [1.0, 3.0], family: 0,
                charted: &[T(Gauss4)], mapped: &[T(Gauss2)], solvers: false, tried: (5, GAUSS),
            },
            Self::VpdAdaptive => Facts {
                takes: Takes::Tableau, symplectic: true, three: false, driven: false, wheels: false, free: false, newton: true,
                lanes: false, plane: false, sweeps: [6.0, 6.0], family: 0,
                charted: &[T(Gauss2), T(Gauss8)], mapped: &[T(Gauss2), T(Gauss4)], solvers: false,
                tried: (8, &[T(Gauss2), T(Gauss4), T(Gauss8)]),
            },
            Self::Vrkmk => Facts {
                takes: Takes::Tableau, symplectic: true, three: false, driven: true, wheels: true, free: false, newton: true,
                lanes: false, plane: false, sweeps: [5.0, 5.0], family: 1,
                charted: &[T(Gauss2), T(Gauss4)],
                mapped: &[T(Gauss1), T(Rk3), T(Gauss2), T(Gauss3), T(Gauss4)], solvers: false,
                tried: (7, &[T(Gauss2), T(Gauss4)]),
            },
            Self::VrkmkProjected => Facts {
                takes: Takes::Tableau, symplectic: true, three: false, driven: true, wheels: true, free: false, newton: true,
                lanes: false, plane: false, sweeps: [5.0, 5.0], family: 1,
                charted: &[], mapped: &[T(Gauss2)], solvers: false, tried: (0, &[]),
            },
            Self::Rkmk => Facts {
                takes: Takes::Explicit, symplectic: false, three: false, driven: true, wheels: true, free: false, newton: false,
                lanes: false, plane: false, sweeps: [1.0, 1.0], family: 5,
                charted: &[T(Rk4), T(Rk8)], mapped: EXPLICIT, solvers: false, tried: (2, &[T(Rk8)]),
            },
            Self::Rk => Facts {
                takes: Takes::Explicit, symplectic: false, three: false, driven: true, wheels: true, free: false, newton: false,
                lanes: false, plane: false, sweeps: [1.0, 1.0], family: 6,
                charted: &[T(Rk4)], mapped: EXPLICIT, solvers: false, tried: (0, &[]),
            },
            Self::RkProjected => Facts {
                takes: Takes::Explicit, symplectic: false, three: false, driven: true, wheels: true, free: false, newton: false,
                lanes: false, plane: false, sweeps: [1.0, 1.0], family: 6,
                charted: &[T(Rk8)], mapped: EXPLICIT, solvers: false, tried: (1, &[T(Rk4), T(Rk8)]),
            },
            Self::Splitting => Facts {
                takes: Takes::Order, symplectic: true, three: true, driven: false, wheels: false, free: false, newton: false,
                lanes: false, plane: false, sweeps: [1.0, 1.0], family: 3,
                charted: &[O(4), O(8)], mapped: &[O(2), O(4), O(6), O(8)], solvers: false,
                tried: (0, &[O(2), O(4), O(6), O(8)]),
            },
            Self::Lgvi => Facts {
                takes: Takes::Order, symplectic: true, three: true, driven: false, wheels: false, free: false, newton: false,
                lanes: false, plane: false, sweeps: [1.0, 1.0], family: 4,
                charted: &[O(4)], mapped: &[O(2), O(4), O(8)], solvers: false, tried: (4, &[O(4), O(8)]),
            },
            Self::QuaternionGauss => Facts {
                takes: Takes::Gauss, symplectic: true, three: true, driven: false, wheels: false, free: false, newton: false,
                lanes: true, plane: false, sweeps: [5.0, 5.0], family: 2,
                charted: &[T(Gauss4), T(Gauss8)],
                mapped: &[T(Gauss1), T(Gauss2), T(Gauss3), T(Gauss4), T(Gauss8)], solvers: false,
                tried: (3, GAUSS),
            },
        }
    }

    /// Returns the stepper for any n; `None` for a method for n = 3 alone, and where the tableau
    /// does not suit it.
    pub(crate) fn in_any_dimension<const N: usize>(
        self,
        parts: Parts,
    ) -> Option<Box<dyn Stepper<N>>> {
        let Parts { tableau, stop, carries_attitude, own_steps, .. } = parts;
        Some(match self {
            Self::Vpd => Box::new(Vpd::new(tableau, stop)),
            Self::VpdAdaptive => {
                let (scale, largest_step_s) = own_steps?;
                Box::new(VpdAdaptive::new(tableau, stop, scale).with_steps_of(largest_step_s))
            }
            Self::VpdLagrangian => Box::new(VpdLagrangian::new(tableau, stop)),
            Self::VpdReduced => Box::new(VpdReduced::new(tableau, stop, carries_attitude)),
            Self::Vrkmk => Box::new(Vrkmk::new(tableau, stop)),
            Self::VrkmkProjected => Box::new(Vrkmk::new(tableau, stop).projected()),
            Self::Rkmk => Box::new(Rkmk::new(tableau)?),
            Self::Rk => Box::new(Rk::new(tableau, false)?),
            Self::RkProjected => Box::new(Rk::new(tableau, true)?),
            Self::Splitting | Self::Lgvi | Self::QuaternionGauss => return None,
        })
    }

    /// Returns the stepper for n = 3, wherever the body goes.
    pub(crate) fn in_three_dimensions(self, parts: Parts) -> Option<Box<dyn Stepper<3>>> {
        if let Some(explicit) = self.explicit_in_three_dimensions(&parts) {
            return Some(Box::new(explicit));
        }
        let in_lanes = parts.tableau.stages() <= WIDTH;
        let Parts { tableau, order, stop, carries_attitude, own_steps } = parts;
        Some(match self {
            // Of a rigid body the two forms are one map.
            Self::Vpd | Self::VpdLagrangian if in_lanes => Box::new(VpdSo3::new(tableau, stop)?),
            Self::VpdReduced if in_lanes => {
                Box::new(VpdSo3::new(tableau, stop)?.reduced(carries_attitude))
            }
            Self::Lgvi => Box::new(Lgvi::new(order, stop)?),
            Self::QuaternionGauss => Box::new(QuaternionGauss::new(tableau.stages(), stop)?),
            _ => {
                let parts = Parts { tableau, order, stop, carries_attitude, own_steps };
                return self.in_any_dimension(parts);
            }
        })
    }

    /// Returns an explicit method for n = 3 in vectors; `None` for any other method, and for more stages than it takes.
    fn explicit_in_three_dimensions(self, parts: &Parts) -> Option<ExplicitSo3> {
        let tableau = || parts.tableau.clone();
        match self {
            Self::Rk => ExplicitSo3::rk(tableau(), false),
            Self::RkProjected => ExplicitSo3::rk(tableau(), true),
            Self::Rkmk => ExplicitSo3::rkmk(tableau()),
            Self::Splitting => ExplicitSo3::splitting(parts.order),
            _ => None,
        }
    }

    /// Returns a stepper for members of an ensemble side by side, where that is quicker than one
    /// after the other; `None` elsewhere. (Free bodies are stepped individually: each step begins
    /// where that member's steps before lead.)
    pub(crate) fn side_by_side(self, parts: &Parts) -> Option<Box<dyn Members<3>>> {
        match self {
            Self::Vpd => Some(Box::new(VpdEnsemble::new(&parts.tableau, parts.stop)?)),
            _ => Some(Box::new(ExplicitEnsemble::new(self.explicit_in_three_dimensions(parts)?))),
        }
    }

    /// Returns whether it is a composition, with an order in the place of a tableau.
    pub fn is_composition(self) -> bool {
        self.facts().takes == Takes::Order
    }

    /// Returns whether it takes explicit tableaux only.
    pub fn is_explicit(self) -> bool {
        self.facts().takes == Takes::Explicit
    }

    /// Returns whether it interpolates matrices, whose smallest singular value its steps then have.
    pub fn interpolates(self) -> bool {
        matches!(self, Self::Vpd | Self::VpdAdaptive | Self::VpdLagrangian | Self::VpdReduced)
    }

    /// Returns the method whose measured costs apply to this one.
    pub fn costs_as(self) -> Self {
        match self {
            Self::VrkmkProjected => Self::Vrkmk,
            Self::VpdAdaptive | Self::VpdLagrangian => Self::Vpd,
            other => other,
        }
    }

    /// Returns all methods, family by family.
    fn by_family() -> Vec<Self> {
        let mut all = Self::ALL.to_vec();
        all.sort_by_key(|method| method.facts().family);
        all
    }

    /// Returns the lines of charts.
    pub(crate) fn charted() -> impl Iterator<Item = (Self, Variant)> {
        let variants = |method: Self| method.facts().charted.iter().map(move |of| (method, *of));
        Self::by_family().into_iter().flat_map(variants)
    }

    /// Returns the rows of the map of stability, and whether each solver has its own.
    pub(crate) fn mapped() -> impl Iterator<Item = (Self, &'static [Variant], bool)> {
        let rows = |method: Self| (method, method.facts().mapped, method.facts().solvers);
        Self::by_family().into_iter().map(rows)
    }

    /// Returns the variants that are tried for an accuracy, in turn.
    pub(crate) fn tried(symplectic: bool) -> impl Iterator<Item = (Self, Variant)> {
        let mut all = Self::ALL.to_vec();
        all.retain(|method| method.facts().symplectic || !symplectic);
        all.sort_by_key(|method| method.facts().tried.0);
        all.into_iter()
            .flat_map(|method| method.facts().tried.1.iter().map(move |of| (method, *of)))
    }

    /// Returns the names of those for which `are` holds, as a sentence has them: `a, b and c`.
    pub(crate) fn names(are: fn(Self) -> bool) -> String {
        let all = Self::ALL.iter().filter(|&&method| are(method));
        let names: Vec<&str> = all.map(|method| method.as_str()).collect();
        match names.split_last() {
            Some((last, [])) => (*last).to_owned(),
            Some((last, others)) => format!("{} and {last}", others.join(", ")),
            None => String::new(),
        }
    }
}

/// The named tableaux: Gauss with 1 to 8 stages (order twice that), Kutta's third and fourth order, and the twelve
/// stages of eighth order of Dormand and Prince, for explicit methods alone.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
#[allow(missing_docs)]
pub enum TableauName {
    Gauss1,
    Gauss2,
    Gauss3,
    Gauss4,
    Gauss5,
    Gauss6,
    Gauss7,
    Gauss8,
    Rk3,
    Rk4,
    Rk8,
}

impl TableauName {
    /// Returns its coefficients.
    pub(crate) fn tableau(self) -> Option<Tableau> {
        match self {
            Self::Gauss1 => Tableau::gauss(1),
            Self::Gauss2 => Tableau::gauss(2),
            Self::Gauss3 => Tableau::gauss(3),
            Self::Gauss4 => Tableau::gauss(4),
            Self::Gauss5 => Tableau::gauss(5),
            Self::Gauss6 => Tableau::gauss(6),
            Self::Gauss7 => Tableau::gauss(7),
            Self::Gauss8 => Tableau::gauss(8),
            Self::Rk3 => Some(Tableau::rk3()),
            Self::Rk4 => Some(Tableau::rk4()),
            Self::Rk8 => Some(Tableau::rk8()),
        }
    }
}
