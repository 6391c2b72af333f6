//! What a log can be told: the core that it goes through does what a robot's would.

use slam_core::geometry::pose::pose;
use slam_core::slam::Slam;

use super::{FASTEST, Player};
use crate::configuration::Configuration;
use crate::live::source::{Answer, Closed, Command, Order, What};
use crate::map_file::MapFile;

/// Coordinates beyond this are no pose, metres.
const FARTHEST_M: f32 = 1e4;

impl Player<'_> {
    /// Does what is asked and answers.
    pub(super) fn obey(&mut self, order: Order) -> Result<(), Closed> {
        let answer = match order.command {
            Command::Forget => self.forget()?,
            Command::SetPose { pose } => self.set_pose(pose),
            Command::Freeze => self.freeze(true),
            Command::Unfreeze => self.freeze(false),
            Command::FindYourself => self.find_yourself(),
            Command::AskMap => self.send_all()?,
            Command::Restart => {
                self.restarts = true;
                Ok("The log begins anew.".into())
            }
            Command::Pace { speed } => self.pace(speed)?,
        };
        order.answer(answer);
        Ok(())
    }

    /// What needs scans to come makes no sense at the end.
    fn goes_on(&self) -> Result<(), String> {
        if self.ended {
            Err("The log has ended, and no scan comes any more. Restart it first.".into())
        } else {
            Ok(())
        }
    }

    fn forget(&mut self) -> Result<Answer, Closed> {
        if let Err(words) = self.run.forget() {
            return Ok(Err(words.to_string()));
        }
        self.driven.clear();
        self.told = super::Told::default();
        self.tell(What::Forgotten)?;
        Ok(Ok("The map is empty; its origin is where the robot stands.".into()))
    }

    fn set_pose(&mut self, [x, y, theta]: [f32; 3]) -> Answer {
        self.goes_on()?;
        self.knows_places("goes on from another pose")?;
        if ![x, y, theta].iter().all(|v| v.abs() < FARTHEST_M) {
            return Err("That is no pose in a building.".into());
        }
        let map = MapFile::of(self.run.mapper.slam());
        map.hand_to(&mut self.run.mapper, Some(pose(x, y, theta)))
            .map_err(|error| format!("{:#}", anyhow::Error::from(error)))?;
        Ok(format!("The robot stands at {x:.2} m, {y:.2} m, heading {:.0}°.", theta.to_degrees()))
    }

    fn freeze(&mut self, frozen: bool) -> Answer {
        self.goes_on()?;
        if self.run.mapper.slam().is_mapping() != frozen {
            return Err(if frozen { "The map is frozen already." } else { "The map learns already." }.into());
        }
        self.run.mapper.set_mapping(!frozen);
        self.told.status_us = None;
        Ok(if frozen {
            "The map stays as it is; the robot finds its way in it."
        } else {
            "The map learns again."
        }
        .into())
    }

    fn find_yourself(&mut self) -> Answer {
        self.goes_on()?;
        self.knows_places("looks for itself")?;
        if self.run.mapper.slam().places().anchors().is_empty() {
            return Err("There is no place yet to look in.".into());
        }
        self.run.mapper.relocalise();
        self.told.status_us = None;
        Ok("The robot may be anywhere in its map, and looks for itself.".into())
    }

    /// Only the default configuration has places, and goes on in a map that it is handed.
    fn knows_places(&self, does_what: &str) -> Result<(), String> {
        match self.source.configuration {
            Configuration::Default => Ok(()),
            other => Err(format!("Only the default configuration {does_what}, not {}.", other.name())),
        }
    }

    fn send_all(&mut self) -> Result<Answer, Closed> {
        self.told.lines.clear();
        self.told.segments.clear();
        self.told.places = Default::default();
        self.tell_map()?;
        let lines = slam_lines(self.run.mapper.slam());
        Ok(Ok(format!("{lines} lines were sent.")))
    }

    fn pace(&mut self, speed: Option<f32>) -> Result<Answer, Closed> {
        if speed.is_some_and(|speed| !speed.is_finite() || speed < 0.0) {
            return Ok(Err("A speed is zero or more.".into()));
        }
        self.speed = speed.filter(|speed| *speed <= FASTEST);
        self.anchor = None;
        self.tell_playback()?;
        Ok(Ok(match self.speed {
            None => "As fast as it goes.".into(),
            Some(0.0) => "Paused.".into(),
            Some(speed) => format!("{speed} times as fast as it was recorded."),
        }))
    }
}

fn slam_lines<const N: usize, const BEAMS: usize, const P: usize>(slam: &Slam<N, BEAMS, P>) -> usize {
    slam.map().segments().len()
}
