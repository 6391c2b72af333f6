//! The robot, from the file that `LINESLAM_ROBOT` names when the firmware is built, or `robots/paper.toml`.

use slam_core::SlamConfig;

include!(concat!(env!("OUT_DIR"), "/robot.rs"));

/// The configuration of the map: the default one, on this robot.
pub fn config() -> SlamConfig {
    let mut config = SlamConfig::default();
    apply(&mut config);
    config
}
