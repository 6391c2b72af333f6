//! Memory of the board, linker arguments, and the robot file as constants.

use std::error::Error;
use std::path::{Path, PathBuf};
use std::{env, fs};

use robot_file::robot::Robot;
use slam_core::geometry::pose::components;

/// Boards, by their features as cargo spells them, and their memory.
const BOARDS: [(&str, &str); 1] = [("NUCLEO_F429ZI", "memory.x")];

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    if env::var("CARGO_CFG_TARGET_OS").is_ok_and(|os| os != "none") {
        return;
    }
    let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets it"));
    let chosen = BOARDS.iter().find(|(feature, _)| env::var_os(format!("CARGO_FEATURE_{feature}")).is_some());
    let Some((_, memory)) = chosen else {
        println!("cargo::error=no board is chosen: name its feature");
        std::process::exit(1);
    };
    println!("cargo::rerun-if-changed={memory}");
    fs::copy(memory, out.join("memory.x")).expect("memory.x can be copied");
    println!("cargo::rustc-link-search={}", out.display());
    // Here and not in the configuration, where RUSTFLAGS would replace them.
    for argument in ["--nmagic", "-Tlink.x", "-Tdefmt.x"] {
        println!("cargo::rustc-link-arg-bins={argument}");
    }
    println!("cargo::rerun-if-env-changed=LINESLAM_ROBOT");
    let robot = env::var("LINESLAM_ROBOT").unwrap_or_else(|_| "robots/paper.toml".into());
    println!("cargo::rerun-if-changed={robot}");
    fs::write(out.join("robot.rs"), constants(Path::new(&robot))).expect("robot.rs can be written");
}

/// What the firmware must know of the robot. A file that cannot be used ends the build with its error.
fn constants(path: &Path) -> String {
    let robot = match Robot::load(path) {
        Ok(robot) => robot,
        Err(error) => {
            // The file, then why; a message of several lines has to be one here.
            let why = error.source().map_or_else(String::new, |why| format!(": {why}").replace('\n', " "));
            println!("cargo::error=LINESLAM_ROBOT: {error}{why}");
            std::process::exit(1);
        }
    };
    // Built-in profiles are part of the crate that reads them.
    for profile in &robot.profile_files {
        println!("cargo::rerun-if-changed={}", profile.display());
    }
    let (Some(drive), Some(_)) = (robot.drive(), robot.beams()) else {
        println!("cargo::error=LINESLAM_ROBOT={}: [wheels] and [sensor.steps] are needed", path.display());
        std::process::exit(1);
    };
    let config = robot.config();
    let (noise, sensor) = (config.odometry.noise, config.sensor);
    let mounting = components(&sensor.mounting.base_from_laser);
    format!(
        "/// Name of the robot file's robot.\n\
         pub const NAME: &str = {:?};\n\
         /// Its wheels.\n\
         pub const DRIVE: slam_core::odometry::DifferentialDrive = slam_core::odometry::{drive:?};\n\
         /// Microseconds from a scan's middle beam to the time that its stamp says.\n\
         pub const SCAN_DELAY_US: i64 = {};\n\
         /// Bit rate to work at with the scanner, bit/s; `None` for the driver's default.\n\
         pub const BAUD_RATE: Option<u32> = {:?};\n\
         /// Pull resistors on the encoders' lines: up 1, down -1, none 0.\n\
         pub const ENCODER_PULL: i8 = {};\n\
         /// Pulses on the encoders' lines that are shorter do not count, nanoseconds.\n\
         pub const ENCODER_FILTER_NS: u32 = {};\n",
        robot.name,
        (robot.sensor.scan_delay_s * 1e6).round() as i64,
        robot.sensor.baud_rate,
        robot.encoders.pull as i8,
        (robot.encoders.filter_us * 1e3).round() as u32,
    ) + &format!(
        "/// Puts sensor, mounting and odometry into a configuration.\n\
         pub fn apply(config: &mut slam_core::SlamConfig) {{\n\
         use slam_core::odometry::*;\n\
         use slam_core::sensor::scan::*;\n\
         config.odometry.noise = {noise:?};\n\
         config.line_noise.sigma_offset_m = {:?};\n\
         config.sensor.geometry = {:?};\n\
         config.sensor.used_steps = {:?};\n\
         config.sensor.codes = {:?};\n\
         config.sensor.noise = {:?};\n\
         config.sensor.mounting = Mounting {{\n\
             base_from_laser: slam_core::geometry::pose::pose({:?}, {:?}, {:?}),\n\
             upside_down: {:?},\n\
         }};\n}}\n",
        config.line_noise.sigma_offset_m,
        sensor.geometry,
        sensor.used_steps,
        sensor.codes,
        sensor.noise,
        mounting.x,
        mounting.y,
        mounting.z,
        sensor.mounting.upside_down,
    )
}
