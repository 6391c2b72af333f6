//! `lineslam live`.

use std::net::{IpAddr, SocketAddr};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use lineslam::emulated::{Board, Drive};
use lineslam::link::{Address, LinkError};
use lineslam::live::log_source::LogSource;
use lineslam::live::robot_source::{self, Emulated};
use lineslam::live::server::{Options, PORT, Server};
use lineslam::live::{browser, foxglove};
use lineslam::robot::Robot;
use lineslam::sim::world::World;
use lineslam::sim::{self, SimConfig, judge};

use super::log_args::{ReadArgs, warn};
use super::start_args::StartArgs;

#[derive(clap::Args)]
#[command(group(clap::ArgGroup::new("source").required(true).args(["log", "simulate", "emulate", "port"])))]
pub struct Args {
    /// The log: a ROS bag (.bag, .mcap, .db3 or its folder), a CARMEN or mines log or JSON lines, these plain or gzipped.
    log: Option<PathBuf>,
    #[command(flatten)]
    reading: ReadArgs,
    /// Instead of a log: drive a simulated robot through this world, whose true walls are shown beneath the map.
    #[arg(long, value_name = "WORLD")]
    simulate: Option<PathBuf>,
    /// Instead of a log: the firmware that is flashed, on an emulated board that drives through this world (a file, or a name in worlds/),
    /// whose true walls are shown beneath the map. Builds what is missing.
    #[arg(long, value_name = "WORLD", conflicts_with_all = ["robot", "config", "map"])]
    emulate: Option<String>,
    /// Instead of a log: a robot. Its port, such as /dev/ttyACM0, or tcp://HOST:PORT of `cargo xtask emulate --vcp PORT`; without a value
    /// that of the ST-LINK that is plugged in.
    #[arg(long, value_name = "PORT", num_args = 0..=1, default_missing_value = "auto", conflicts_with_all = ["robot", "config", "map", "speed"])]
    port: Option<String>,
    /// Seed of the simulated or emulated drive.
    #[arg(long, default_value_t = 1, conflicts_with_all = ["log", "port"])]
    seed: u64,
    /// Change an error of the simulated robot, or have something happen to it; `lineslam simulate --help` has all keys.
    #[arg(long = "set", value_name = "KEY=VALUE", conflicts_with_all = ["log", "port"])]
    settings: Vec<String>,
    #[command(flatten)]
    begin: StartArgs,
    /// Times as fast as it was recorded; 0 begins paused, `max` goes as fast as it can. The page can change it, but for an emulated robot.
    #[arg(long, value_name = "TIMES", default_value = "1", value_parser = speed)]
    speed: Speed,
    /// Let other computers see the page: an address of this one, or 0.0.0.0 for all, with a port if it is not to be 8017. There is no
    /// password: whoever reaches it sees the map and can command the robot.
    #[arg(long, value_name = "ADDRESS[:PORT]", default_value = "127.0.0.1", value_parser = listen)]
    listen: SocketAddr,
    /// A name by which other computers know this one; without it the page is to be opened by address.
    #[arg(long = "host", value_name = "NAME")]
    names: Vec<String>,
    /// Also serve map, path, scan and pose for Foxglove, at ws://127.0.0.1:PORT.
    #[arg(long, value_name = "PORT")]
    foxglove: Option<u16>,
    /// Do not open the page in a browser.
    #[arg(long)]
    no_open: bool,
}

/// Times as fast as recorded; none is as fast as it can.
#[derive(Clone, Copy)]
struct Speed(Option<f32>);

fn speed(text: &str) -> Result<Speed, String> {
    if text == "max" {
        return Ok(Speed(None));
    }
    let number = text.parse().ok().filter(|v: &f32| v.is_finite() && *v >= 0.0);
    number.map(|number| Speed(Some(number))).ok_or_else(|| "expected a number, zero or more, or max".into())
}

fn listen(text: &str) -> Result<SocketAddr, String> {
    let address = text.parse::<SocketAddr>().ok();
    let address = address.or_else(|| text.parse::<IpAddr>().ok().map(|ip| (ip, PORT).into()));
    address.ok_or_else(|| "expected an address such as 127.0.0.1, 0.0.0.0 or 192.168.1.4:8080".into())
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    args.begin.check()?;
    // The port first: a large log takes a while to read.
    let server = Server::bind(&Options { listen: args.listen, names: args.names.clone() })?;
    // It runs as long as this is there.
    let board = args.emulate.as_deref().map(|world| emulated(world, args)).transpose()?;
    let source = match (&args.port, &args.simulate, &board) {
        (_, _, Some((board, scene))) => robot_source::start_emulated(board.address().clone(), scene.clone())?,
        (Some(port), _, _) => robot_source::start(address(port)?)?,
        (None, Some(world), _) => simulated(world, args)?.start()?,
        (None, None, None) => recorded(args.log.as_deref().context("no log")?, args)?.start()?,
    };
    // It serves as long as this is there.
    let (source, foxglove) = match args.foxglove {
        None => (source, None),
        Some(port) => {
            let (source, server) = foxglove::tee(source, port)
                .with_context(|| format!("--foxglove {port}: cannot serve at 127.0.0.1:{port}"))?;
            (source, Some(server))
        }
    };
    let url = server.url();
    println!("{url}");
    if let Some(foxglove) = &foxglove {
        eprintln!("For Foxglove: ws://127.0.0.1:{}", foxglove.port());
    }
    if server.is_open() {
        eprintln!(
            "warning: whoever reaches {} sees the map and can command the robot: there is no password. Without --listen only this \
             computer can.",
            server.address()
        );
    }
    if !args.no_open
        && let Err(error) = browser::show(&url)
    {
        eprintln!("no browser was opened ({error}): open the address above yourself");
    }
    eprintln!("Ctrl-C ends it.");
    server.run(source, async {
        // Where it cannot be waited for, the system ends the program by itself.
        if tokio::signal::ctrl_c().await.is_err() {
            std::future::pending::<()>().await;
        }
    })?;
    Ok(())
}

fn address(port: &str) -> Result<Address, LinkError> {
    if port == "auto" { Address::find() } else { port.parse() }
}

/// The board, and what is known of its world.
fn emulated(world: &str, args: &Args) -> anyhow::Result<(Board, Emulated)> {
    if args.speed.0 == Some(0.0) {
        bail!("--speed 0: an emulated robot cannot be paused");
    }
    let mut drive = Drive::new(world, args.seed, args.speed.0)?;
    drive.settings.clone_from(&args.settings);
    let world = World::load(&drive.world)?;
    let blueprint = judge::blueprint_from(&world, &world.path.start());
    let title = format!("{}, seed {}, emulated", world.name, args.seed);
    Ok((drive.start()?, Emulated { title, blueprint }))
}

fn recorded(path: &Path, args: &Args) -> anyhow::Result<LogSource> {
    let given = args.begin.robot()?;
    let wheels = given.as_ref().is_some_and(|robot| robot.wheels.is_some());
    let log = args.reading.read(path, given.as_ref(), wheels)?;
    warn(&log.warnings);
    let robot = given.unwrap_or_else(|| log.usual_robot());
    let title = path.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
    Ok(LogSource {
        log,
        robot,
        configuration: args.begin.config,
        start: args.begin.start(None)?,
        speed: args.speed.0,
        title,
        blueprint: None,
    })
}

fn simulated(world: &Path, args: &Args) -> anyhow::Result<LogSource> {
    let world = World::load(world)?;
    let robot = args.begin.robot()?.unwrap_or_else(|| Robot::usual_for("simulated"));
    let mut errors = SimConfig::default();
    for setting in &args.settings {
        errors.set(setting)?;
    }
    let drive = sim::drive(&world, &robot, &errors, args.seed)?;
    let blueprint = judge::blueprint_in_map(&world, &drive);
    Ok(LogSource {
        log: drive.log,
        robot,
        configuration: args.begin.config,
        start: args.begin.start(None)?,
        speed: args.speed.0,
        title: format!("{}, seed {}", world.name, args.seed),
        blueprint: Some(blueprint),
    })
}
