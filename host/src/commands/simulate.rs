//! `lineslam simulate`.

use std::path::PathBuf;

use lineslam::log;
use lineslam::output::report::{Report, SimulationReport};
use lineslam::output::svg::Scene;
use lineslam::output::{self, tum};
use lineslam::replay::Start;
use lineslam::robot::Robot;
use lineslam::sim::world::World;
use lineslam::sim::{self, SimConfig, SimKind, judge};

use super::common::{Configuration, print_summary, results};

#[derive(clap::Args)]
pub struct Args {
    /// World file: walls, things, people, and the robot's path.
    world: PathBuf,
    /// Seed of all noise; the same seed gives the same drive.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Robot file. By default paper.toml.
    #[arg(long, value_name = "FILE")]
    robot: Option<PathBuf>,
    /// Which algorithm.
    #[arg(long, value_enum, default_value_t = Configuration::Default)]
    config: Configuration,
    /// Folder for all that replay writes, and for log.jsonl, which replay reads, and truth.tum.
    #[arg(long, value_name = "FOLDER", default_value = "out")]
    out: PathBuf,
    /// Also record the run as ROS 2 messages in this MCAP file, for ros2 bag play, RViz and Foxglove.
    #[arg(long, value_name = "FILE")]
    mcap: Option<PathBuf>,
    /// What the robot and the building are like: ideal (noise that averages out, walls as drawn), or real (bias, slip
    /// at starts, glass, walls that are not straight, stamps that jitter).
    #[arg(long, value_enum, default_value_t = Kind::Ideal)]
    kind: Kind,
    /// Change an error of that kind: wheel.radius_error, wheel.radius_difference, wheel.track_error,
    /// wheel.slip_m_per_sqrt_m, wheel.turn_slip, wheel.start_slip_share, wheel.start_slip_deg, wheel.spins_per_min,
    /// wheel.spin_m, wheel.caster_kick_deg, sensor.sigma_m, sensor.sigma_per_m, sensor.uniform_m, sensor.dropout,
    /// sensor.mixed_pixels, sensor.least_incidence, sensor.edge_loss, sensor.fade_m, sensor.skip_every, sensor.delay_s, sensor.bias, sensor.warm_up_m,
    /// sensor.warm_up_s, sensor.dark_reach_m, sensor.glass_through, sensor.speckle, sensor.tilt, sensor.height_m,
    /// clock.revolution, clock.jitter_s, clock.hiccups, clock.offset_s, wall.bow_m, wall.skirting_m. Or have something
    /// happen: fault.spin_left_at_s, fault.spin_right_at_s (with spin_s, spin_m_s), fault.lift_at_s (lift_s, lift_by_m,
    /// lift_turn_deg), fault.restart_at_s, fault.swap_at_s, fault.reverse_left_at_s, fault.reverse_right_at_s,
    /// fault.dead_left_at_s, fault.dead_right_at_s.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    settings: Vec<String>,
}

/// A named set of errors.
#[derive(Clone, Copy, Debug, clap::ValueEnum)]
enum Kind {
    Ideal,
    Real,
}

impl From<Kind> for SimKind {
    fn from(kind: Kind) -> Self {
        match kind {
            Kind::Ideal => Self::Ideal,
            Kind::Real => Self::Real,
        }
    }
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let world = World::load(&args.world)?;
    let robot = args.robot.as_deref().map_or_else(|| Ok(Robot::usual_for("simulated")), Robot::load)?;
    let mut errors = SimConfig::of(args.kind.into());
    for setting in &args.settings {
        errors.set(setting)?;
    }
    let drive = sim::drive(&world, &robot, &errors, args.seed)?;
    let result = super::common::run(&Start::default(), &drive.log, &robot, args.config)?;
    let mut report = Report::new(&drive.log, &robot, args.config.name(), &result);
    report.simulation = Some(SimulationReport::new(&world, &drive, &result, args.seed, errors));
    let caption = format!("{}, seed {}", world.name, args.seed);
    let blueprint = judge::blueprint_in_map(&world, &drive);
    let scene = Scene {
        title: &caption,
        subtitle: args.config.subtitle(),
        blueprint: &blueprint,
        ..Scene::default()
    };
    let mut files = results(&drive.log, &result, &report, &scene, args.mcap.as_deref())?;
    files.push(("log.jsonl".into(), log::plain_text(&drive.log, &robot).into_bytes()));
    let stamps = drive.log.scans.iter().map(|s| s.stamp_us);
    files.push(("truth.tum".into(), tum::render_f64(stamps.zip(&drive.truth)).into_bytes()));
    output::write_all(&args.out, &files)?;
    print_summary("world", &caption, &args.out, &report);
    Ok(())
}
