//! What a run is judged by, and the files it leaves.

use lineslam::log::{Log, LoggedScan, Odometry, plain_text};
use lineslam::robot::Robot;
use lineslam::sim::judge::{self, TrajectoryErrors};
use lineslam::sim::world::World;
use lineslam::sim::{Drive, UnitErrors};
use nalgebra::{Isometry2, Point2, Vector2};
use serde::Serialize;
use slam_core::capacity::{PLACES, SAMPLES, SEGMENTS};
use slam_core::geometry::pose::pose;
use slam_core::odometry::Integration;
use slam_core::sensor::scan::Reading;
use slam_core::tracking::TrackingState;
use slam_core::{MapSegment, Mapper, Segment, WheelTicks};

use crate::record::{Entry, Event};
use crate::run::Outcome;

/// `report.json`.
#[derive(Debug, Serialize)]
pub struct Report {
    /// Name of the world.
    pub world: String,
    /// Of all noise.
    pub seed: u64,
    /// Virtual time, seconds.
    pub virtual_s: f64,
    /// Whether the path was driven to its end.
    pub arrived: bool,
    /// Scans that the sensor sent.
    pub scans_sent: usize,
    /// Scans that the firmware took in.
    pub scans_used: usize,
    /// Mean error of the map's corners, equation (11), metres.
    pub corner_error_m: Option<f64>,
    /// Corners that the map has.
    pub corners_found: usize,
    /// Corners of the blueprint.
    pub corners: usize,
    /// Errors of the trajectory.
    #[serde(flatten)]
    pub trajectory: TrajectoryErrors,
    /// Largest distance of a pose from the truth, metres.
    pub worst_position_error_m: f64,
    /// Error of the stamps that the firmware gave its scans, microseconds: mean, largest.
    pub stamp_error_us: [i64; 2],
    /// By how much scans are stamped late by the firmware's own estimate, and its standard deviation, as its status said last,
    /// seconds; `None` where the run was too short for one.
    pub estimated_delay_s: Option<[f32; 2]>,
    /// Segments of the map.
    pub segments: usize,
    /// What a scan takes on the microcontroller, microseconds: median, 99 of 100, largest.
    pub update_us: [u32; 3],
    /// Share of the processor's time that goes into scans.
    pub cpu_share: f64,
    /// Resets while it ran.
    pub resets: usize,
    /// Warnings and errors in the log.
    pub warnings: usize,
    /// Most bytes of stack used: in all, by thread mode where it was interrupted, and by the urgent executor. Zero where the run
    /// was too short to say.
    pub stack_bytes: [u32; 3],
    /// Bytes of the firmware's variables.
    pub static_bytes: u64,
    /// Instructions executed.
    pub instructions: u64,
    /// Cycles of one of them: by the model, or assumed of all.
    pub cycles_per_instruction: f64,
}

/// The run as a drive with its truth, scan by scan.
pub struct Judged {
    /// Scans that the firmware used, and where the robot was.
    pub drive: Drive,
    /// What the firmware made of each.
    pub poses: Vec<Isometry2<f32>>,
    /// Its map, as it printed it.
    pub map: Vec<MapSegment>,
    /// The verdict.
    pub report: Report,
}

/// Judges a run.
pub fn judge(world: &World, seed: u64, outcome: &Outcome) -> anyhow::Result<Judged> {
    let map = printed_map(outcome)?;
    let mut drive = Drive {
        log: Log { format: "emulated", ..Log::default() },
        truth: Vec::new(),
        true_wheels: ([0.0; 2], 0.0),
        unit: UnitErrors::NONE,
    };
    let mut poses = Vec::new();
    let mut took: Vec<u32> = Vec::new();
    let mut late_us: Vec<i64> = Vec::new();
    let mut samples: Vec<WheelTicks> = Vec::new();
    let mut sent = outcome.scans.iter();
    for (number, entry) in outcome.entries.iter().enumerate() {
        samples.extend(&entry.samples);
        let Event::Scan { middle_us, ranges_mm, took_us, .. } = &entry.event else { continue };
        // They come in the order in which they were sent.
        let Some(truth) = sent.by_ref().find(|s| s.ranges_mm == *ranges_mm) else {
            anyhow::bail!("the firmware took in a scan at {middle_us} µs that the sensor never sent");
        };
        let ticks = samples.iter().rev().find(|s| s.stamp_us <= *middle_us).copied().unwrap_or_default();
        let counters = [ticks.left, ticks.right].map(|t| i64::from(t as u16));
        drive.log.odometry.push((truth.middle_us, Odometry::Ticks(counters)));
        let ranges_mm = ranges_mm.clone();
        drive.log.scans.push(LoggedScan {
            line: number + 1,
            stamp_us: truth.middle_us,
            ranges_mm,
            geometry: None,
        });
        drive.truth.push(truth.world_from_base);
        poses.push(entry.map_from_base());
        took.push(*took_us);
        late_us.push(*middle_us as i64 - truth.middle_us as i64);
    }
    let corners = judge::corner_errors(world, &drive, &map);
    let in_world = judge::in_world(&drive, poses.iter().copied());
    let off =
        |(t, p): (&Isometry2<f64>, &Isometry2<f64>)| (t.translation.vector - p.translation.vector).norm();
    let busy_us: u64 = took.iter().map(|t| u64::from(*t)).sum();
    took.sort_unstable();
    let share = |q: usize| took.get((took.len().saturating_sub(1)) * q / 100).copied().unwrap_or(0);
    let report = Report {
        world: world.name.clone(),
        seed,
        virtual_s: outcome.end_us as f64 * 1e-6,
        arrived: outcome.arrived,
        scans_sent: outcome.scans.len(),
        scans_used: poses.len(),
        corner_error_m: (!corners.is_empty()).then(|| corners.iter().sum::<f64>() / corners.len() as f64),
        corners_found: corners.len(),
        corners: world.corners.len(),
        trajectory: judge::trajectory_errors(&drive.truth, &in_world),
        worst_position_error_m: drive.truth.iter().zip(&in_world).map(off).fold(0.0, f64::max),
        stamp_error_us: [
            late_us.iter().sum::<i64>() / late_us.len().max(1) as i64,
            late_us.iter().map(|us| us.abs()).max().unwrap_or(0),
        ],
        estimated_delay_s: estimated_delay_s(outcome),
        segments: map.len(),
        update_us: [share(50), share(99), share(100)],
        cpu_share: busy_us as f64 / outcome.end_us.max(1) as f64,
        resets: outcome.resets.len(),
        warnings: outcome.log.iter().filter(|l| l.level == "WARN" || l.level == "ERROR").count(),
        stack_bytes: stack_bytes(outcome),
        static_bytes: outcome.static_bytes,
        instructions: outcome.instructions,
        cycles_per_instruction: outcome.cycles_per_instruction,
    };
    Ok(Judged { drive, poses, map, report })
}

/// What the firmware's status said of its stack, at the most.
fn stack_bytes(outcome: &Outcome) -> [u32; 3] {
    let said = outcome.log.iter().filter_map(|line| {
        let (all, rest) = line.text.strip_prefix("stack: ")?.split_once(" bytes at most, ")?;
        let (thread, rest) = rest.split_once(" in thread mode, ")?;
        let (urgent, _) = rest.split_once(' ')?;
        Some([all.parse().ok()?, thread.parse().ok()?, urgent.parse().ok()?])
    });
    said.fold([0u32; 3], |most, now: [u32; 3]| std::array::from_fn(|k| most[k].max(now[k])))
}

/// The delay that the firmware's status said last.
fn estimated_delay_s(outcome: &Outcome) -> Option<[f32; 2]> {
    outcome.log.iter().rev().find_map(|line| {
        let (_, rest) = line.text.split_once(" permille, delay ")?;
        let (delay_s, rest) = rest.split_once(" s, sigma ")?;
        let (sigma_s, _) = rest.split_once(" s, ")?;
        Some([delay_s.parse().ok()?, sigma_s.parse().ok()?])
    })
}

/// The map that the firmware printed last when its button was pressed.
fn printed_map(outcome: &Outcome) -> anyhow::Result<Vec<MapSegment>> {
    let is_head = |text: &str| text == "walls of the map";
    let from = outcome.log.iter().rposition(|l| is_head(&l.text));
    let lines = from.and_then(|n| outcome.log.get(n + 1..)).unwrap_or(&[]);
    let mut map = Vec::new();
    for line in lines.iter().take_while(|l| l.text != "end of map") {
        let Some(rest) = line.text.strip_prefix("segment ") else { continue };
        let words: Vec<&str> = rest.split(' ').collect();
        let [x0, y0, x1, y1, "points", points, "scans", scans] = words[..] else {
            anyhow::bail!("the firmware printed a segment as '{}'", line.text);
        };
        let end = |x: &str, y: &str| anyhow::Ok(Point2::new(x.parse::<f32>()?, y.parse::<f32>()?));
        let (start, end) = (end(x0, y0)?, end(x1, y1)?);
        // The free side is on the left.
        let along: Vector2<f32> = end - start;
        let free = nalgebra::center(&start, &end) + Vector2::new(-along.y, along.x);
        // The variance says how sure the line is; nothing that is judged asks.
        let segment = Segment::from_ends(start, end, points.parse()?, 1.0, free);
        let hits = scans.parse()?;
        map.push(MapSegment::new(&segment, hits, 0, 0.0));
    }
    Ok(map)
}

/// The log in the plain format, which `lineslam replay` reads.
pub fn log_text(judged: &Judged, robot: &Robot) -> String {
    plain_text(&judged.drive.log, robot)
}

/// Points of all scans in `map`, for the drawing.
pub fn points(judged: &Judged, robot: &Robot) -> Vec<Point2<f32>> {
    let config = robot.config();
    let (geometry, mounting) = (config.sensor.geometry, config.sensor.mounting.base_from_laser);
    let mut points = Vec::new();
    for (scan, pose) in judged.drive.log.scans.iter().zip(&judged.poses).step_by(3) {
        for (beam, &value) in scan.ranges_mm.iter().enumerate() {
            if let Reading::Range(range) = config.sensor.codes.read(value) {
                let in_laser = Isometry2::rotation(geometry.bearing(beam)) * Point2::new(range, 0.0);
                points.push(pose * mounting * in_laser);
            }
        }
    }
    points
}

/// Dead reckoning by the ticks that the firmware took in.
pub fn dead_reckoning(outcome: &Outcome, robot: &Robot) -> Vec<Isometry2<f32>> {
    let Some(drive) = robot.drive() else { return Vec::new() };
    let (mut path, mut pose) = (Vec::new(), Isometry2::identity());
    let mut before: Option<WheelTicks> = None;
    for entry in &outcome.entries {
        for sample in &entry.samples {
            if let Some(b) = before {
                let (left, right) = (sample.left.wrapping_sub(b.left), sample.right.wrapping_sub(b.right));
                pose *= drive.increment(left, right, Integration::Arc).before_from_after;
            }
            before = Some(*sample);
        }
        path.push(pose);
    }
    path
}

/// Where a PC and the firmware part.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Difference {
    /// The entry after which they differ.
    pub entry: usize,
    /// x, y, θ on the PC.
    pub here: [f32; 3],
    /// x, y, θ on the board.
    pub board: [f32; 3],
    /// The tracking state on the PC, and on the board.
    pub states: [TrackingState; 2],
}

/// Where a PC, fed the same ticks and scans, parts from the firmware: `None` if it never does.
/// A reset in the middle of a scan leaves what no PC can know; the comparison ends there.
pub fn first_difference(entries: &[Entry], robot: &Robot) -> anyhow::Result<Option<Difference>> {
    let mut mapper = mapper(robot)?;
    for (number, entry) in known(entries).enumerate() {
        follow(&mut mapper, entry, robot)?;
        let here = slam_core::geometry::pose::components(&mapper.slam().pose());
        let same = (0..3).all(|i| here[i].to_bits() == entry.pose[i].to_bits())
            && mapper.slam().map().segments().len() == entry.segments as usize
            && mapper.slam().state() == entry.state;
        if !same {
            let states = [mapper.slam().state(), entry.state];
            let (here, board) = (here.into(), entry.pose.into());
            return Ok(Some(Difference { entry: number, here, board, states }));
        }
    }
    Ok(None)
}

/// The mapper of a PC that was fed the same ticks and scans, as far as they are known.
pub fn replayed(entries: &[Entry], robot: &Robot) -> anyhow::Result<Box<FirmwareMapper>> {
    let mut mapper = mapper(robot)?;
    known(entries).try_for_each(|entry| follow(&mut mapper, entry, robot))?;
    Ok(mapper)
}

/// The sizes of `src/kept.rs`.
pub type FirmwareMapper = Mapper<SEGMENTS, SAMPLES, 682, PLACES>;

fn mapper(robot: &Robot) -> anyhow::Result<Box<FirmwareMapper>> {
    let drive = robot.drive().ok_or_else(|| anyhow::anyhow!("robot '{}' has no wheels", robot.name))?;
    Ok(Box::new(Mapper::new(robot.config(), drive)?))
}

fn known(entries: &[Entry]) -> impl Iterator<Item = &Entry> {
    entries.iter().take_while(|e| e.event != Event::Recovered)
}

/// Does what the firmware did.
fn follow(mapper: &mut FirmwareMapper, entry: &Entry, robot: &Robot) -> anyhow::Result<()> {
    if entry.event == Event::Resumed {
        mapper.resume();
    }
    for sample in &entry.samples {
        mapper.push(*sample);
    }
    match &entry.event {
        Event::Resumed | Event::Recovered => {}
        Event::Scan { middle_us, ranges_mm, revolution_us, .. } => {
            mapper.set_revolution_us(*revolution_us);
            let _ = mapper.scan(*middle_us, ranges_mm);
        }
        Event::Coasted { until_us } => drop(mapper.coast(*until_us)),
        Event::Forgotten => *mapper = Mapper::new(robot.config(), robot.drive())?,
        Event::PoseSet([x, y, heading]) => mapper.set_pose(pose(*x, *y, *heading)),
        Event::Frozen | Event::Unfrozen => mapper.set_mapping(entry.event == Event::Unfrozen),
        Event::Relocalising => mapper.relocalise(),
    }
    Ok(())
}
