//! `lineslam connect`.

use std::io::{IsTerminal, Write, stderr, stdin, stdout};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use lineslam::emulated::{Board, Drive, Driven};
use lineslam::link::from_robot::{Cause, Health, Hello, Pose, Status};
use lineslam::link::{Address, Client, Command, FromRobot, LinkError, MapCopy, Streams, words};
use lineslam::live::robot_source::{self, Emulated};
use lineslam::live::screen;
use lineslam::output::tum;
use slam_core::geometry::pose::pose;

#[derive(clap::Args)]
pub struct Args {
    /// Port of the robot: a device such as /dev/ttyACM0, or tcp://HOST:PORT of `cargo xtask emulate --vcp PORT`. By default that of the
    /// ST-LINK that is plugged in.
    #[arg(long, value_name = "PORT", global = true)]
    port: Option<Address>,
    /// Instead of a robot: the firmware that is flashed, on an emulated board that drives through this world (a file, or a name in worlds/).
    /// Builds what is missing, and ends with the drive; `map` prints the map of the whole drive.
    #[arg(long, value_name = "WORLD", global = true, conflicts_with = "port")]
    emulate: Option<String>,
    /// Seed of the emulated drive.
    #[arg(long, default_value_t = 1, global = true)]
    seed: u64,
    /// Print the trajectory, a line of TUM format for each scan.
    #[arg(long)]
    tum: bool,
    /// Print a line a second, also on a terminal, which otherwise shows a screen of it.
    #[arg(long, conflicts_with = "tum")]
    lines: bool,
    /// End after so many seconds.
    #[arg(long, value_name = "N")]
    seconds: Option<u64>,
    #[command(subcommand)]
    ask: Option<Ask>,
}

/// What to ask of the robot.
#[derive(clap::Subcommand)]
enum Ask {
    /// Forget the map and begin a new one here.
    Forget {
        /// Do not ask whether it is meant so.
        #[arg(long)]
        yes: bool,
    },
    /// Say where the robot stands in its map: within some 20 cm and 6 degrees.
    SetPose {
        /// Metres.
        #[arg(allow_negative_numbers = true)]
        x: f32,
        /// Metres.
        #[arg(allow_negative_numbers = true)]
        y: f32,
        /// Heading, degrees.
        #[arg(allow_negative_numbers = true)]
        deg: f32,
    },
    /// Leave the map as it is, and only find the way in it.
    Freeze,
    /// Let the map learn again.
    Unfreeze,
    /// Find yourself: the robot may be anywhere in its map.
    Find,
    /// Print the map: both ends of each line (metres), scans that saw it, and whether it is a wall, as CSV.
    Map,
    /// Reset the board; the map is kept.
    Restart,
}

/// A map that is not whole by then has something wrong.
const WHOLE_MAP: Duration = Duration::from_secs(20);
/// Nothing was heard for so long: it is said.
const SILENCE: Duration = Duration::from_secs(3);
/// A port that is gone is tried again this often.
const RETRY: Duration = Duration::from_millis(500);

pub fn run(args: &Args) -> anyhow::Result<()> {
    if let Some(world) = &args.emulate {
        return emulated(world, args);
    }
    let address = args.port.clone().map_or_else(Address::find, Ok)?;
    match &args.ask {
        Some(ask) => tell(&address, ask),
        None => watch(args, &address, None),
    }
}

/// The same with an emulated robot. It ends with this, so that there is no use in changing what it does.
fn emulated(world: &str, args: &Args) -> anyhow::Result<()> {
    match &args.ask {
        None => {
            let mut board = Drive::new(world, args.seed, Some(1.0))?.start()?;
            let address = board.address().clone();
            watch(args, &address, Some(&mut board))
        }
        Some(Ask::Map) => {
            let mut board = Drive::new(world, args.seed, None)?.start()?;
            eprintln!("the robot drives; its map comes at the end");
            board.wait()?;
            print_map(board.address())
        }
        Some(_) => bail!(
            "the emulated robot ends with this command, so it can be watched and print its map; to tell it something, run `lineslam live \
             --emulate {world}`, or `cargo xtask emulate --world {world} --vcp 7411` and this with --port tcp://127.0.0.1:7411"
        ),
    }
}

fn tell(address: &Address, ask: &Ask) -> anyhow::Result<()> {
    let (command, done) = match ask {
        Ask::Forget { yes } => {
            if !yes && !confirmed()? {
                println!("the map stays");
                return Ok(());
            }
            (Command::Forget, "the map is forgotten, and a new one begins")
        }
        Ask::SetPose { x, y, deg } => {
            (Command::SetPose([*x, *y, deg.to_radians()]), "the robot goes on from there")
        }
        Ask::Freeze => (Command::SetMapping(false), "the map stays as it is"),
        Ask::Unfreeze => (Command::SetMapping(true), "the map learns"),
        Ask::Find => (Command::Relocalise, "the robot looks for itself"),
        Ask::Restart => (Command::Restart, "the board restarts"),
        Ask::Map => return print_map(address),
    };
    order(&mut Client::connect(address)?, command)?;
    println!("{done}");
    Ok(())
}

/// Has it done.
fn order(client: &mut Client, command: Command) -> anyhow::Result<()> {
    match words::of_refusal(client.request(command)?) {
        None => Ok(()),
        Some(why) => bail!("{}: {why}", client.address()),
    }
}

fn confirmed() -> anyhow::Result<bool> {
    if !stdin().is_terminal() {
        bail!("the robot would forget its map: say so with --yes");
    }
    eprint!("Forget the robot's map? It cannot be had back. [y/N] ");
    stderr().flush()?;
    let mut answer = String::new();
    stdin().read_line(&mut answer).context("the answer")?;
    Ok(matches!(answer.trim(), "y" | "Y" | "yes"))
}

fn print_map(address: &Address) -> anyhow::Result<()> {
    let mut client = Client::connect(address)?;
    order(&mut client, Command::Subscribe(Streams::DEFAULT.with(Streams::MAP)))?;
    order(&mut client, Command::SendMap { blocks: u32::MAX, places: true })?;
    let mut map = MapCopy::default();
    let begun = Instant::now();
    while !map.is_whole() {
        if begun.elapsed() > WHOLE_MAP {
            bail!("{address}: the map has not come whole within {} s", WHOLE_MAP.as_secs());
        }
        if let Some(message) = client.next(RETRY)?
            && let Some(again) = map.take(&message)
        {
            client.send(again)?;
        }
    }
    order(&mut client, Command::Subscribe(Streams::DEFAULT))?;
    println!("x0,y0,x1,y1,scans,wall");
    for (_, line) in map.lines() {
        let ([x0, y0], [x1, y1]) = (line.start_m, line.end_m);
        println!("{x0},{y0},{x1},{y1},{},{}", line.hits, line.is_wall);
    }
    Ok(())
}

/// Shows what comes until it is interrupted, through resets and pulled cables, or until an emulated board's drive is over.
fn watch(args: &Args, address: &Address, mut board: Option<&mut Board>) -> anyhow::Result<()> {
    let end = args.seconds.map(|seconds| Instant::now() + Duration::from_secs(seconds));
    let driven = board.as_ref().map(|board| board.drive());
    let is_over =
        || end.is_some_and(|end| Instant::now() >= end) || driven.as_ref().is_some_and(Driven::is_over);
    if stdout().is_terminal() && !args.tum && !args.lines {
        let source = match &args.emulate {
            None => robot_source::start(address.clone())?,
            Some(world) => robot_source::start_emulated(
                address.clone(),
                Emulated { title: format!("{world}, seed {}, emulated", args.seed), blueprint: Vec::new() },
            )?,
        };
        return screen::show(source, is_over).context("the terminal");
    }
    // The first time it must be there.
    let mut client = Some(Client::connect(address)?);
    let mut shown = Shown { tum: args.tum, ..Shown::default() };
    while !is_over() {
        let Some(open) = &mut client else {
            std::thread::sleep(RETRY);
            client = Client::connect(address).ok();
            continue;
        };
        if let Err(error) = show(open, &mut shown, &is_over) {
            if let Some(board) = &mut board {
                board.check()?;
            }
            eprintln!("{error}: waiting for it to come back");
            client = None;
        }
    }
    if shown.messages == 0 {
        bail!("{address}: nothing was heard; is the firmware of this version on the board?");
    }
    Ok(())
}

fn show(client: &mut Client, shown: &mut Shown, is_over: &impl Fn() -> bool) -> Result<(), LinkError> {
    client.send(Command::Subscribe(Streams::DEFAULT))?;
    client.send(Command::Hello)?;
    let (mut heard, mut is_silent) = (Instant::now(), false);
    while !is_over() {
        match client.next(Duration::from_millis(100))? {
            Some(message) => {
                (heard, is_silent) = (Instant::now(), false);
                shown.take(&message);
            }
            None if heard.elapsed() > SILENCE && !is_silent => {
                is_silent = true;
                eprintln!("nothing has been heard for {} s: what is above is old", SILENCE.as_secs());
            }
            None => {}
        }
    }
    Ok(())
}

/// What is known for the next line.
#[derive(Default)]
struct Shown {
    tum: bool,
    messages: u64,
    pose: Option<Pose>,
    status: Option<Status>,
}

impl Shown {
    fn take(&mut self, message: &FromRobot) {
        self.messages += 1;
        match message {
            FromRobot::Pose(of) => {
                if self.tum && of.cause == Cause::Scan {
                    let [x, y, heading] = of.pose;
                    print!("{}", tum::render([(of.at_us, &pose(x, y, heading))].into_iter()));
                }
                self.pose = Some(*of);
            }
            // Nothing but the trajectory.
            _ if self.tum => {}
            FromRobot::Hello(hello) => print_hello(hello),
            FromRobot::Event(happened) => {
                println!("{:9.1} s  {}", seconds(happened.at_us), words::of_event(&happened.event));
            }
            FromRobot::Status(status) => self.status = Some(status.clone()),
            FromRobot::Health(health) => self.line(health),
            _ => {}
        }
    }

    /// A line once a second.
    fn line(&mut self, health: &Health) {
        let (Some(pose), Some(status)) = (&self.pose, &self.status) else { return };
        let [x, y, heading] = pose.pose;
        let sigma_m = (pose.covariance[0].max(0.0) + pose.covariance[3].max(0.0)).sqrt();
        let lost =
            status.sensor_missed + status.sensor_dropped + status.samples_dropped + health.scans_unsent;
        println!(
            "{:9.1} s  x {x:.3} y {y:.3} m, {:.1}°, sure within {sigma_m:.3} m; {}{}; {} lines, {} places; {} scans; {:.1} ms a scan, cpu {:.1} %; lost {lost}",
            seconds(health.uptime_us),
            heading.to_degrees(),
            words::of_state(pose.state),
            if status.mapping { "" } else { ", the map is frozen" },
            pose.lines,
            status.places,
            status.scans,
            f64::from(health.scan_us) * 1e-3,
            f64::from(health.mapping_permille + health.link_permille) * 0.1,
        );
    }
}

fn seconds(us: u64) -> f64 {
    us as f64 * 1e-6
}

fn print_hello(hello: &Hello) {
    println!(
        "robot '{}': lineslam {} on {}, up for {:.1} s, reset by {:?}, kept map {:?}; room for {} lines and {} places; {} beams",
        hello.robot,
        hello.firmware,
        hello.board,
        seconds(hello.uptime_us),
        hello.reset,
        hello.kept,
        hello.lines,
        hello.places,
        hello.scanner.beams
    );
}
