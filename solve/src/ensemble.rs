//! Members of an ensemble, carried forward together.
//!
//! Invariant: a member makes the steps of its own run, to the bit, whatever members go next to it; one that fails stays where
//! it was, one that a condition stops stays there, and the others go on.

use super::failure::Failure;
use super::hamiltonian::RigidBody;
use super::lanes::WIDTH;
use super::nonlinear::Convergence;
use super::state::State;
use super::stepper::{Knots, Stepper};
use super::system::System;
use super::trajectory::{Bookkeeping, Observables, Sample, Schedule, Trajectory};

/// A few members of an ensemble that take each step together.
pub trait Members<const N: usize> {
    /// Takes the numbers of the members that start next, for what differs between members apart from their start: see
    /// [`Stepper::set_member`].
    fn set_numbers(&mut self, _numbers: &[u64]) {}

    /// Begins at the states, at most [`WIDTH`] of them.
    fn start(&mut self, states: &[State<N>]);

    /// Carries the members of `going` forward by `h` seconds from the time `begun_s`, in parts that end at knots between;
    /// gives the result of each to `stepped`.
    fn step(
        &mut self,
        body: &RigidBody<N>,
        begun_s: f64,
        h: f64,
        going: &[usize],
        stepped: &mut dyn FnMut(usize, Result<Convergence, Failure>),
    );

    /// Brings member `m` to the end of its last step: see [`Stepper::synchronise`].
    ///
    /// # Errors
    /// Any failure.
    fn synchronise(&mut self, _body: &RigidBody<N>, _h: f64, _m: usize) -> Result<u32, Failure> {
        Ok(0)
    }

    /// Returns member `m` as it is. One that makes steps by itself takes no more steps with the others.
    fn member(&mut self, m: usize) -> &mut dyn Stepper<N>;
}

/// Members one after the other, with any scheme.
pub struct Sequential<const N: usize> {
    steppers: [Box<dyn Stepper<N>>; WIDTH],
    knots: Knots,
}

impl<const N: usize> Sequential<N> {
    /// Creates the members of an ensemble by their steppers.
    pub fn new(steppers: [Box<dyn Stepper<N>>; WIDTH]) -> Self {
        Self { steppers, knots: Knots::default() }
    }
}

impl<const N: usize> Members<N> for Sequential<N> {
    fn set_numbers(&mut self, numbers: &[u64]) {
        self.steppers.iter_mut().zip(numbers).for_each(|(stepper, &m)| stepper.set_member(m));
    }

    fn start(&mut self, states: &[State<N>]) {
        self.knots = Knots::default();
        self.steppers.iter_mut().zip(states).for_each(|(stepper, state)| stepper.start(state));
    }

    fn step(
        &mut self,
        body: &RigidBody<N>,
        begun_s: f64,
        h: f64,
        going: &[usize],
        stepped: &mut dyn FnMut(usize, Result<Convergence, Failure>),
    ) {
        let before = self.knots;
        for &m in going {
            self.knots = before;
            stepped(m, self.knots.step(body, self.steppers[m].as_mut(), begun_s, h));
        }
    }

    fn synchronise(&mut self, body: &RigidBody<N>, h: f64, m: usize) -> Result<u32, Failure> {
        self.steppers[m].synchronise(body, h)
    }

    fn member(&mut self, m: usize) -> &mut dyn Stepper<N> {
        self.steppers[m].as_mut()
    }
}

/// Carries the states, at most [`WIDTH`], forward along `schedule`, side by side, and gives the samples to `record`
/// with the number of their member, in the order of time, those of a time in that of the members. `go_on(steps_done)` is
/// asked before each step.
///
/// # Errors
/// Those of `record`. A step that fails is not an error but an [`super::trajectory::Ending`] of its member.
pub fn integrate<const N: usize, E>(
    body: &RigidBody<N>,
    members: &mut dyn Members<N>,
    initial: &[State<N>],
    schedule: Schedule,
    observables: Observables,
    mut record: impl FnMut(usize, &Sample<N>) -> Result<(), E>,
    mut go_on: impl FnMut(u64) -> bool,
) -> Result<Vec<Trajectory<N>>, E> {
    let Schedule { step_s, steps, every } = schedule;
    let every = every.max(1);
    members.start(initial);
    let mut bookkeeping: Vec<Bookkeeping<N>> =
        initial.iter().map(|state| Bookkeeping::new(body, state, step_s, observables)).collect();
    let mut sample = |m: usize, bookkeeping: &mut Bookkeeping<N>, members: &mut dyn Members<N>| {
        let settled = bookkeeping.needs_sample().then(|| members.synchronise(body, step_s, m));
        match bookkeeping.sample(body, settled, members.member(m)) {
            Some(sample) => record(m, &sample),
            None => Ok(()),
        }
    };
    let is_located = body.stops().iter().any(|stop| stop.exact);
    // Where a step began, of those that go on.
    let mut begun = Vec::new();
    let mut going: Vec<usize> = (0..initial.len()).collect();
    let mut step = 0;
    loop {
        let over = step == steps;
        if over || step % every == 0 {
            for &m in &going {
                sample(m, &mut bookkeeping[m], members)?;
            }
            going.retain(|&m| bookkeeping[m].goes_on());
        }
        if over || going.is_empty() {
            break;
        }
        if !go_on(step) {
            for &m in &going {
                bookkeeping[m].cancelled();
                sample(m, &mut bookkeeping[m], members)?;
            }
            break;
        }
        if is_located {
            begun.extend(going.iter().map(|&m| bookkeeping[m].begun(members.member(m))));
        }
        members.step(body, step as f64 * step_s, step_s, &going, &mut |m, result| {
            bookkeeping[m].stepped(result)
        });
        step += 1;
        let mut begun = begun.drain(..);
        for &m in &going {
            if !body.stops().is_empty() {
                bookkeeping[m].look_for_a_stop(body, members.member(m));
            }
            if let Some(begun) = begun.next() {
                bookkeeping[m].end_within(body, members.member(m), begun);
            }
        }
        let mut ended = Vec::new();
        going.retain(|&m| {
            let goes_on = bookkeeping[m].goes_on();
            ended.extend((!goes_on).then_some(m));
            goes_on
        });
        // One may have ended within the step before another did.
        ended.sort_by(|&a, &b| bookkeeping[a].time_s().total_cmp(&bookkeeping[b].time_s()));
        for m in ended {
            sample(m, &mut bookkeeping[m], members)?;
        }
    }
    Ok(bookkeeping.into_iter().map(Bookkeeping::end).collect())
}
