//! What a PC asks for is done here, once, and answered.

use ::link::Command;
use ::link::from_robot::{Cause, Outcome};
use embassy_time::{Duration, Instant};
use nalgebra::Isometry2;
use slam_core::geometry::pose;

use super::{Incoming, Outbox};
use crate::kept::Keeper;

/// The answer to a restart has so long to be sent.
const LAST_WORDS: Duration = Duration::from_millis(50);
/// Farther away from the map's origin there is nothing, metres.
const FARTHEST_M: f32 = 1e5;

/// A restart that has been asked for.
#[derive(Default)]
pub struct Restart(Option<Instant>);

impl Restart {
    /// Resets the board when it is time to.
    pub fn when_due(&self, outbox: &Outbox) {
        if self.0.is_some_and(|at| Instant::now() >= at || outbox.is_answered()) {
            cortex_m::peripheral::SCB::sys_reset();
        }
    }
}

impl Outbox {
    /// Does what is asked for, and answers. What it did to the map, if anything. `samples` have been taken in by now.
    #[inline(never)]
    pub fn obey(
        &mut self,
        incoming: Incoming,
        samples: u32,
        keeper: &mut Keeper,
        restart: &mut Restart,
    ) -> Option<Cause> {
        let request = match incoming {
            Incoming::Request(request) => request,
            Incoming::Unknown(id) => {
                defmt::warn!("link: a request that is not known");
                self.unsent.unknown = self.unsent.unknown.wrapping_add(1);
                self.answer(id, Outcome::Unknown);
                return None;
            }
        };
        if let Some(answered) = self.answered.filter(|answered| answered.id == request.id) {
            self.answer(answered.id, answered.outcome);
            return None;
        }
        let (outcome, cause) = self.apply(request.command, samples, keeper, restart);
        defmt::info!("link: {}: {}", request.command, outcome);
        self.answer(request.id, outcome);
        cause
    }

    fn apply(
        &mut self,
        command: Command,
        samples: u32,
        keeper: &mut Keeper,
        restart: &mut Restart,
    ) -> (Outcome, Option<Cause>) {
        match command {
            Command::Hello => self.hello(),
            Command::Subscribe(streams) => self.subscribe(streams, samples),
            Command::SendMap { blocks, places } => self.map.repeat(blocks, places),
            Command::Restart => restart.0 = Some(Instant::now() + LAST_WORDS),
            Command::Forget => match keeper.forget() {
                Ok(()) => return (Outcome::Done, Some(Cause::Forgotten)),
                Err(_) => return (Outcome::NotConfigured, None),
            },
            Command::SetPose(to) => match place(to) {
                Some(at) => {
                    keeper.update(|mapper| mapper.set_pose(at));
                    return (Outcome::Done, Some(Cause::PoseSet(to)));
                }
                None => return (Outcome::OutOfRange, None),
            },
            Command::SetMapping(mapping) => {
                keeper.update(|mapper| mapper.set_mapping(mapping));
                return (Outcome::Done, Some(if mapping { Cause::Unfrozen } else { Cause::Frozen }));
            }
            Command::Relocalise => {
                if keeper.mapper().slam().config().relocalisation.is_none() {
                    return (Outcome::NotConfigured, None);
                }
                keeper.update(crate::kept::Mapper::relocalise);
                return (Outcome::Done, Some(Cause::Relocalising));
            }
        }
        (Outcome::Done, None)
    }
}

fn place([x, y, heading]: [f32; 3]) -> Option<Isometry2<f32>> {
    let makes_sense = [x, y].iter().all(|v| v.abs() < FARTHEST_M) && heading.abs() < 1e3;
    makes_sense.then(|| pose::pose(x, y, heading))
}
