//! `cargo xtask emulate` runs this.

mod page;

use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Context;
use clap::Parser;
use comfy_table::{Table, presets};
use emulator::fault::Fault;
use emulator::report::{self, Judged};
use emulator::run::{Outcome, Plan, Seen, run_with};
use emulator::vcp::{self, FarEnd, Hold, Nobody, Socket};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use lineslam::emulated::{IS_OVER, PORT_IS};
use lineslam::output::svg::{self, Picture, Scene};
use lineslam::output::{self, csv, tum};
use lineslam::robot::Robot;
use lineslam::sim::world::World;
use lineslam::sim::{SimConfig, judge};
use page::Page;

/// Runs the firmware on an emulated board in a simulated building.
#[derive(Parser)]
#[command(bin_name = "cargo xtask emulate")]
struct Cli {
    /// The firmware.
    #[arg(long, value_name = "ELF")]
    firmware: PathBuf,
    /// World: a name in worlds/, or a file.
    #[arg(long, default_value = "hall")]
    world: String,
    /// Robot file that the firmware was built for.
    #[arg(long, value_name = "FILE", default_value = "robots/paper.toml")]
    robot: PathBuf,
    /// Seed of all noise.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Length of the run, seconds of virtual time. By default it ends when the path does.
    #[arg(long, value_name = "N")]
    seconds: Option<u64>,
    /// Folder for trajectory.tum, truth.tum, map.csv, map.svg, log.jsonl, log.txt, link.bin (all bytes of the virtual COM port), link.tum (its poses) and report.json.
    #[arg(long, value_name = "FOLDER", default_value = "out")]
    out: PathBuf,
    /// What goes wrong: unplug@S+S, garble=N, line=N, noise=N, start-noise=N, streaming=BIT/S, good-to=BIT/S, reset@S, dma-held@S+S,
    /// held@S+S, clock@S=MS, skew=PPM, slow=PPM, quirk=NAME, stamp-wrap, hse-dead, hse-dies@S, power@S=PERMILLE,
    /// sag@S+S, probe-gone@S+S, hold@S+S, order@S=N, glitch=NS, vcp-noise@S+S. May be given again.
    #[arg(long = "fault", value_name = "FAULT")]
    faults: Vec<Fault>,
    /// Change an error of the simulated robot, as in `lineslam simulate`.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    settings: Vec<String>,
    /// Have each instruction take as many cycles as the model of the core says. Takes several times as long.
    #[arg(long)]
    cycles: bool,
    /// Offer the virtual COM port on this TCP port of 127.0.0.1 (0: on any that is free), and run no faster than a real board:
    /// `lineslam connect --port tcp://127.0.0.1:PORT`.
    #[arg(long, value_name = "PORT")]
    vcp: Option<u16>,
    /// Show the drive on a page in the browser while it runs. A page that was opened stays until Ctrl-C.
    #[arg(long, conflicts_with = "vcp")]
    page: bool,
    /// Do not open the page in a browser.
    #[arg(long, requires = "page")]
    no_open: bool,
    /// With --vcp or --page: times as fast as a real board, or `max`. 1 with --vcp, max with --page.
    #[arg(long, value_name = "TIMES", value_parser = speed)]
    speed: Option<Speed>,
    /// Belongs to the program that started it: says when the drive is over, goes on until standard input is closed, writes nothing.
    #[arg(long, hide = true, requires = "vcp")]
    attended: bool,
    /// Print the firmware's log as it comes.
    #[arg(long)]
    log: bool,
}

/// Steps of the progress bar.
const BAR: u64 = 1000;

fn main() -> ExitCode {
    match emulate(&Cli::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn emulate(cli: &Cli) -> anyhow::Result<()> {
    let file = PathBuf::from(&cli.world);
    let file = if file.exists() { file } else { Path::new("worlds").join(format!("{}.toml", cli.world)) };
    let world = World::load(&file)?;
    let robot = Robot::load(&cli.robot)?;
    let mut sim = SimConfig::default();
    for setting in &cli.settings {
        sim.set(setting)?;
    }
    let plan = Plan {
        elf: &cli.firmware,
        world: &world,
        robot: &robot,
        sim,
        seed: cli.seed,
        seconds: cli.seconds,
        faults: cli.faults.clone(),
        cycles: cli.cycles,
    };
    let (far_end, page) = far_end(cli, &world)?;
    let bar = progress_bar(cli.attended);
    let (shown, with_log, attended) = (bar.clone(), cli.log, cli.attended);
    let outcome = run_with(&plan, far_end, move |seen| match seen {
        Seen::Line(line) if with_log => shown.suspend(|| println!("{line}")),
        Seen::Line(_) => {}
        Seen::Over if attended => println!("{IS_OVER}"),
        Seen::Over => {}
        Seen::Progress(p) => {
            shown.set_position((p.driven * BAR as f64) as u64);
            shown.set_message(format!(
                "{:.0} s of virtual time, {:.3} m off, {} segments, {:.1} ms a scan",
                p.now_us as f64 * 1e-6,
                p.error_m,
                p.segments,
                f64::from(p.took_us) * 1e-3
            ));
        }
    })?;
    bar.finish_and_clear();
    let judged = report::judge(&world, cli.seed, &outcome)?;
    let files = files(&world, &robot, &outcome, &judged)?;
    output::write_all(&cli.out, &files)?;
    print_summary(&judged, &outcome, &cli.out);
    if let Some(page) = page {
        page.stay();
    }
    Ok(())
}

/// Times as fast as a real board; none is as fast as it goes.
#[derive(Clone, Copy)]
struct Speed(Option<f64>);

fn speed(text: &str) -> Result<Speed, String> {
    if text == "max" {
        return Ok(Speed(None));
    }
    let number = text.parse().ok().filter(|v: &f64| v.is_finite() && *v > 0.0);
    number.map(|number| Speed(Some(number))).ok_or_else(|| "expected a number above zero, or max".into())
}

/// Who is at the other end of the virtual COM port.
fn far_end(cli: &Cli, world: &World) -> anyhow::Result<(Box<dyn FarEnd>, Option<Page>)> {
    if cli.page {
        let socket = Socket::listen(0, cli.speed.and_then(|speed| speed.0))?;
        let page = Page::show(&socket, world, cli.seed, !cli.no_open)?;
        return Ok((Box::new(socket), Some(page)));
    }
    let Some(port) = cli.vcp else { return Ok((Box::new(Nobody), None)) };
    let socket = Socket::listen(port, cli.speed.unwrap_or(Speed(Some(1.0))).0)?;
    if cli.attended {
        end_with_input(socket.hold());
    }
    println!("{PORT_IS}tcp://{}", socket.address()?);
    Ok((Box::new(socket), None))
}

/// Ends this program when standard input is closed: whoever started it has gone, in whatever way.
fn end_with_input(hold: Hold) {
    std::thread::spawn(move || {
        let _hold = hold;
        // Nothing is said there. An error is as good as an end.
        let _ = std::io::copy(&mut std::io::stdin(), &mut std::io::sink());
        std::process::exit(0);
    });
}

fn files(
    world: &World,
    robot: &Robot,
    outcome: &Outcome,
    judged: &Judged,
) -> anyhow::Result<Vec<(&'static str, Vec<u8>)>> {
    let stamps = || judged.drive.log.scans.iter().map(|s| s.stamp_us);
    let picture = Picture {
        map: &judged.map,
        path: judged.poses.clone(),
        odometry: report::dead_reckoning(outcome, robot),
        points: report::points(judged, robot),
        distance_m: judged
            .drive
            .truth
            .windows(2)
            .map(|p| (p[1].translation.vector - p[0].translation.vector).norm())
            .sum(),
    };
    let blueprint = judge::blueprint_in_map(world, &judged.drive);
    let title = format!("{}, seed {}", judged.report.world, judged.report.seed);
    let scene = Scene {
        title: &title,
        subtitle: "mapped by the firmware on the emulated board",
        blueprint: &blueprint,
        ..Scene::default()
    };
    let poses = vcp::scan_poses(&outcome.vcp);
    let log: String = outcome.log.iter().map(|line| format!("{line}\n")).collect();
    let mut report = serde_json::to_vec_pretty(&judged.report).context("report.json")?;
    report.push(b'\n');
    Ok(vec![
        ("trajectory.tum", tum::render(stamps().zip(&judged.poses)).into_bytes()),
        ("truth.tum", tum::render_f64(stamps().zip(&judged.drive.truth)).into_bytes()),
        ("map.csv", csv::render(&judged.map).context("map.csv")?),
        ("map.svg", svg::render(&picture, &scene).into_bytes()),
        ("log.jsonl", report::log_text(judged, robot).into_bytes()),
        ("log.txt", log.into_bytes()),
        ("link.tum", tum::render(poses.iter().map(|(stamp_us, pose)| (*stamp_us, pose))).into_bytes()),
        ("link.bin", outcome.vcp.clone()),
        ("report.json", report),
    ])
}

fn progress_bar(hidden: bool) -> ProgressBar {
    let style = ProgressStyle::with_template("{bar:30.cyan/dim} {percent} %  {msg}  ({elapsed})")
        .expect("the template is a constant");
    let target = if std::io::stderr().is_terminal() && !hidden {
        ProgressDrawTarget::stderr()
    } else {
        ProgressDrawTarget::hidden()
    };
    ProgressBar::with_draw_target(Some(BAR), target).with_style(style)
}

fn print_summary(judged: &Judged, outcome: &Outcome, out: &Path) {
    let r = &judged.report;
    let corners = match r.corner_error_m {
        Some(error_m) => format!("{error_m:.3} m, {} of {} found", r.corners_found, r.corners),
        None => format!("none of {} found", r.corners),
    };
    let [median, p99, max] = r.update_us.map(|us| f64::from(us) * 1e-3);
    let kib = |bytes: u32| f64::from(bytes) / 1024.0;
    let rows = [
        ("world", format!("{}, seed {}", r.world, r.seed)),
        (
            "driven",
            format!(
                "{:.0} s of virtual time{}",
                r.virtual_s,
                if r.arrived { "" } else { ", not to the end" }
            ),
        ),
        ("scans", format!("{} sent, {} used", r.scans_sent, r.scans_used)),
        ("corner error, eq. (11)", corners),
        (
            "trajectory error, rmse",
            format!("{:.3} m, at worst {:.3} m", r.trajectory.ate_rmse_m, r.worst_position_error_m),
        ),
        ("map", format!("{} segments", r.segments)),
        ("a scan on the microcontroller", format!("median {median:.2} ms, p99 {p99:.2} ms, max {max:.2} ms")),
        ("of the processor's time", format!("{:.1} %", 100.0 * r.cpu_share)),
        (
            "RAM",
            format!(
                "{:.1} KiB of variables, {:.1} KiB of stack at most ({:.1} in thread mode, {:.1} in the urgent executor)",
                r.static_bytes as f64 / 1024.0,
                kib(r.stack_bytes[0]),
                kib(r.stack_bytes[1]),
                kib(r.stack_bytes[2])
            ),
        ),
        ("resets, warnings", format!("{}, {}", r.resets, r.warnings)),
        (
            "instructions",
            format!(
                "{:.0} million, of {:.2} cycles on average",
                outcome.instructions as f64 * 1e-6,
                r.cycles_per_instruction
            ),
        ),
        ("written to", out.display().to_string()),
    ];
    let mut table = Table::new();
    table.load_style(presets::NOTHING);
    for (name, value) in rows {
        table.add_row([name.to_owned(), value]);
    }
    println!("{table}");
}
