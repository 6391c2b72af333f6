//! What is odd about a drive: above all whether the odometry and the scanner tell of the same one.
//!
//! The turn between two scans is read from the scans alone: the ranges of the second are those of the first, moved by as many
//! beams as the robot turned. That is rough, but it leans on nothing that is doubted here.
//!
//! The limits are ours. Chosen on odd inputs around one simulated drive (wheels swapped, an encoder reversed or dead, odometry
//! frozen: fewer than a third of the turns agree, or none) and on recorded logs, whose odometry is good: exp1, exp3, fr079, fr101,
//! fhw, test_lab2 (more than three quarters agree). Logs of key scans alone have too few pairs to be judged.

use slam_core::odometry::wheel_faults::WheelFault;
use slam_core::sensor::scan::{Reading, SensorConfig};

use super::{Log, Warning};
use crate::output::tracking::Tracking;
use crate::replay::{Replay, Step};
use crate::robot::Robot;

/// That there is no odometry, for programs.
const NO_ODOMETRY: &str = "no_odometry";
/// Turns by odometry that are compared, radians: larger than what the scans' shift is off by, smaller than what they share.
const COMPARED_RAD: std::ops::Range<f32> = 0.06..0.6;
/// Farther apart two scans are not alike, metres.
const MOST_WAY_M: f32 = 0.15;
/// A turn that a standing odometry must not have, radians.
const TURNED_RAD: f32 = 0.1;
/// Odometry that turned less than this stands, radians.
const STANDS_RAD: f32 = 0.002;
/// Pairs of scans that are looked at, and the least from which something is said.
const MOST_PAIRS: usize = 600;
const LEAST_PAIRS: usize = 20;
/// Turns agree within this, radians, or this share of the turn.
const AGREES_RAD: f32 = 0.05;
const AGREES_SHARE: f32 = 0.4;
/// Differences of ranges count up to this, metres.
const MOST_DIFFERENCE_M: f32 = 0.3;
/// Share of ranges that are distances, at the least: even in a hall too large for the scanner some are.
const LEAST_POINTS: f64 = 0.02;
/// Each so-manieth beam is compared, and so many must be at least.
const BEAM_STRIDE: usize = 3;
const LEAST_BEAMS: usize = 20;

/// Scans that overrule the odometry, beyond which it is said; one or two may on a good drive.
const FEW_LEFT_OUT: usize = 3;

/// What is odd about a drive.
pub fn of_drive(log: &Log, robot: &Robot, replay: &Replay) -> Vec<Warning> {
    let mut warnings = Vec::new();
    // A reader that knows why there is none has said it.
    let said = log.warnings.iter().any(|warning| warning.suspected == NO_ODOMETRY);
    if !log.odometry.is_empty() {
        // Where the fault has a name, it goes before what is only odd; a scanner that hangs head down looks like swapped wheels.
        let fault = replay.steps.last().and_then(|step| step.update.wheel_fault);
        if matches!(fault, None | Some(WheelFault::Swapped)) {
            warnings.extend(odometry_against_scanner(log, robot, &replay.steps));
        }
    } else if !said {
        let message = "the log has no odometry: the robot is followed by its scanner alone";
        warnings.push(Warning::new(NO_ODOMETRY, message));
    }
    warnings.extend(unlike_the_robot(robot, replay));
    warnings.extend(wheel_fault(&replay.steps));
    if let Some(first) = replay.restarts_us.first() {
        let at = at_s(&replay.steps, *first);
        let n = replay.restarts_us.len();
        let times = if n == 1 { "once".to_owned() } else { format!("{n} times") };
        let message = format!(
            "the counters restarted {times}, first {at:.1} s into the log: what the wheels did meanwhile is not known"
        );
        warnings.push(Warning::new("counters_restarted", message));
    }
    let looked_at: u32 =
        replay.steps.iter().map(|s| s.update.deskew).map(|d| d.points + d.no_echo + d.bad).sum();
    let points: u32 = replay.steps.iter().map(|s| s.update.deskew.points).sum();
    if f64::from(points) < LEAST_POINTS * f64::from(looked_at) {
        let message = format!(
            "only {points} of {looked_at} ranges are distances, the others codes or out of the scanner's limits: the ranges may be \
             in another unit (--ranges), or the scanner another one (--robot)"
        );
        warnings.push(Warning::new("hardly_any_distances", message));
    }
    warnings.extend(of_tracking(&Tracking::of(&replay.steps), !log.odometry.is_empty()));
    warnings
}

/// Poses that are not those of the robot that recorded the drive, though nothing is missing from the recording.
fn unlike_the_robot(robot: &Robot, replay: &Replay) -> Option<Warning> {
    let agreement = replay.agreement?;
    let first = agreement.first_different?;
    let file = if robot.usual { ": give its robot file with --robot" } else { "" };
    let message = format!(
        "the poses are not those that the robot had, from its pose {first} on: robot file or firmware are others than the robot \
         runs{file}"
    );
    Some(Warning::new("unlike_the_robot", message))
}

/// What the core itself found wrong.
fn of_tracking(tracking: &Tracking, has_odometry: bool) -> Vec<Warning> {
    let mut warnings = Vec::new();
    match (tracking.first_useless_s, tracking.first_left_out_s) {
        _ if !has_odometry => {}
        // What was overruled before that is of the same kind, and no slip.
        (Some(first_s), _) => {
            let message = format!(
                "the odometry was of no use in {} scans, first at t = {first_s:.1} s, and overruled in {} others: it did not tell of \
                 the motion that the scanner saw, and the robot was followed by its scanner alone",
                tracking.odometry_useless, tracking.odometry_left_out
            );
            warnings.push(Warning::new("odometry_useless", message));
        }
        (None, Some(first_s)) if tracking.odometry_left_out > FEW_LEFT_OUT => {
            let message = format!(
                "the wheels slipped or spun: in {} scans, first at t = {first_s:.1} s, the scanner overruled them",
                tracking.odometry_left_out
            );
            warnings.push(Warning::new("odometry_slipped", message));
        }
        _ => {}
    }
    if let Some(first_s) = tracking.first_lost_s {
        let message = format!(
            "the robot was lost in {} scans, first at t = {first_s:.1} s: what they showed did not fit the map, or nothing was \
             recognised for long. Poses from there on are not to be relied on until it is found again",
            tracking.lost
        );
        warnings.push(Warning::new("tracking_lost", message));
    }
    warnings
}

/// The fault of the wheels that was seen for longest, if it was seen in more than a few scans.
fn wheel_fault(steps: &[Step]) -> Option<Warning> {
    let faults = || steps.iter().filter_map(|step| step.update.wheel_fault);
    let scans = |fault| faults().filter(|f| *f == fault).count();
    let fault = faults().max_by_key(|fault| scans(*fault))?;
    let first = steps.iter().find(|step| step.update.wheel_fault == Some(fault))?;
    if scans(fault) < LEAST_PAIRS {
        return None;
    }
    let at = at_s(steps, first.stamp_us);
    let message = format!("{} (seen from {at:.1} s into the log on)", fault.message());
    Some(Warning::new("wheel_fault", message))
}

/// Seconds into the log.
fn at_s(steps: &[Step], stamp_us: u64) -> f64 {
    let first = steps.first().map_or(0, |step| step.stamp_us);
    stamp_us.saturating_sub(first) as f64 * 1e-6
}

/// What wheels and scanner say against each other, if they do.
fn odometry_against_scanner(log: &Log, robot: &Robot, steps: &[Step]) -> Option<Warning> {
    let turn_of =
        |k: usize| slam_core::geometry::pose::heading(&steps[k].motion.since_previous.before_from_after);
    let pairs = |fits: &dyn Fn(f32) -> bool| -> Vec<(f32, f32)> {
        let near = |k: &usize| steps[*k].motion.since_previous.distance_m < MOST_WAY_M;
        let chosen: Vec<usize> = (1..steps.len()).filter(|k| fits(turn_of(*k).abs()) && near(k)).collect();
        let stride = chosen.len().div_ceil(MOST_PAIRS).max(1);
        let seen =
            chosen.iter().step_by(stride).filter_map(|k| Some((turn_of(*k), seen_turn(log, robot, *k)?)));
        seen.collect()
    };
    let turning = pairs(&|turn| COMPARED_RAD.contains(&turn));
    let standing = pairs(&|turn| turn < STANDS_RAD);
    let near = |a: f32, b: f32| (a - b).abs() < AGREES_RAD.max(AGREES_SHARE * a.abs());
    let agree = turning.iter().filter(|(said, seen)| near(*said, *seen)).count();
    let opposite = turning.iter().filter(|(said, seen)| near(*said, -*seen)).count();
    let n = turning.len();
    if n >= LEAST_PAIRS && opposite > agree && 2 * opposite > n {
        return Some(Warning::new(
            "odometry_turns_the_other_way",
            format!(
                "in {opposite} of {n} turns the scanner turns the other way than the odometry says: the wheels seem swapped, or \
                 the scanner hangs head down (upside_down in the robot file)"
            ),
        ));
    }
    if n >= LEAST_PAIRS && 2 * agree < n {
        return Some(Warning::new(
            "odometry_contradicts_scanner",
            format!(
                "in only {agree} of {n} turns scanner and odometry turn alike: a wheel's encoder may be dead or reversed, the \
                 stamps of one may be late (scan_delay_s in the robot file), or its wheels wrong; see 'lineslam calibrate'"
            ),
        ));
    }
    let moved = standing.iter().filter(|(_, seen)| seen.abs() > TURNED_RAD).count();
    if standing.len() >= LEAST_PAIRS && moved >= LEAST_PAIRS && 20 * moved > standing.len() {
        return Some(Warning::new(
            "odometry_frozen",
            format!(
                "between {moved} of {} pairs of scans the scanner turned while the odometry says that the robot stood: the \
                 odometry seems frozen",
                standing.len()
            ),
        ));
    }
    None
}

/// The robot's turn between a scan and the one before, counter-clockwise, radians, as the scans say.
fn seen_turn(log: &Log, robot: &Robot, k: usize) -> Option<f32> {
    let sensor = robot.sensor_for(&log.layout(k));
    if sensor.geometry != robot.sensor_for(&log.layout(k - 1)).geometry {
        return None;
    }
    let [before, after] = [k - 1, k].map(|k| ranges_m(log, &sensor, k));
    let step_rad = sensor.geometry.step_rad();
    let reach = ((COMPARED_RAD.end + TURNED_RAD) / step_rad) as isize;
    let misfit = |shift: isize| {
        let (mut sum, mut n) = (0.0, 0);
        for beam in (0..after.len()).step_by(BEAM_STRIDE) {
            let earlier = usize::try_from(beam as isize + shift).ok().and_then(|b| before.get(b));
            if let (Some(a), Some(Some(b))) = (after[beam], earlier) {
                sum += (a - b).abs().min(MOST_DIFFERENCE_M);
                n += 1;
            }
        }
        (n >= LEAST_BEAMS).then(|| sum / n as f32)
    };
    let fits = (-reach..=reach).filter_map(|shift| Some((misfit(shift)?, shift)));
    let (_, shift) = fits.min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.abs().cmp(&b.1.abs())))?;
    let side = if sensor.mounting.upside_down { -1.0 } else { 1.0 };
    Some(side * shift as f32 * step_rad)
}

fn ranges_m(log: &Log, sensor: &SensorConfig, k: usize) -> Vec<Option<f32>> {
    let reading = |value: &u16| match sensor.codes.read(*value) {
        Reading::Range(range_m) => Some(range_m),
        Reading::NoEcho | Reading::Bad => None,
    };
    log.scans[k].ranges_mm.iter().map(reading).collect()
}
