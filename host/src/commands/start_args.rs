//! What every command takes that runs the core: with which robot and algorithm, and in which map it begins.

use std::path::PathBuf;

use lineslam::map_file::{MapFile, MapFileError};
use lineslam::replay::Start;
use lineslam::robot::Robot;
use nalgebra::Isometry2;

use super::common::Configuration;

#[derive(clap::Args)]
pub struct StartArgs {
    /// Robot file: wheels, scanner, mounting. Without it what the log states is used; what it does not, such as noise, is that of
    /// mines.toml for a mines log, of paper.toml for a simulated drive and of sick.toml for others.
    #[arg(long, value_name = "FILE")]
    robot: Option<PathBuf>,
    /// Which algorithm.
    #[arg(long, value_enum, default_value_t = Configuration::Default)]
    pub config: Configuration,
    /// Begin in this map, a map.json of replay, and go on mapping. Where the robot stands in it is looked for.
    #[arg(long, value_name = "FILE")]
    map: Option<PathBuf>,
    /// Only find the way in the map: it stays as it is.
    #[arg(long, requires = "map")]
    localise: bool,
}

impl StartArgs {
    /// The robot, if one is given.
    pub fn robot(&self) -> anyhow::Result<Option<Robot>> {
        Ok(self.robot.as_deref().map(Robot::load).transpose()?)
    }

    /// Fails where the algorithm begins in no map.
    pub fn check(&self) -> Result<(), MapFileError> {
        match &self.map {
            Some(_) if self.config != Configuration::Default => {
                Err(MapFileError::Configuration(self.config.name()))
            }
            _ => Ok(()),
        }
    }

    /// How to begin, in the map at a pose if one is given.
    pub fn start(&self, pose: Option<Isometry2<f32>>) -> Result<Start, MapFileError> {
        self.check()?;
        let map = self.map.as_deref().map(MapFile::load).transpose()?;
        // In another map, or with another algorithm, what the robot did is not to be had.
        let follows = map.is_none() && self.config == Configuration::Default;
        Ok(Start { map, pose, frozen: self.localise, follows })
    }
}
