//! 4 · The mathematics: rotating bodies on SO(n) and the integrators that carry them forward.
//!
#![doc = include_str!("../README.md")]
//!
//! # Inside
//!
//! Pure: no I/O, clock, threads, serialisation or logging. A tag such as (24c, vih3) is an equation of the paper: its number
//! in print, and its label in the source of the paper.
//! Runtime sizes are const `N` here; symbols follow the paper and are listed in NOTATION.md.
//!
//! Invariant: a step either leaves finite values or a named failure ([`failure::Failure`]).

pub mod bodies;
pub mod compensated;
pub mod composition;
pub mod control;
pub mod ensemble;
pub mod failure;
pub mod free_top;
pub mod hamiltonian;
pub mod kepler;
pub mod lagrangian;
pub mod lanes;
pub mod noise;
pub mod nonlinear;
pub mod pointing;
pub mod so;
pub mod so3;
pub mod space;
pub mod stack;
pub mod state;
pub mod stepper;
pub mod stop;
pub mod system;
pub mod tableau;
pub mod tangent;
mod time;
pub mod trajectory;
pub mod work;
