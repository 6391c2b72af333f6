//! What a drive says about wheels, delay and mounting.
//!
//! In: a log with wheel ticks, and the robot file that describes the robot nearly. Out: wheel radii, track, delay between
//! scans and ticks, and the scanner's mounting, with their uncertainties, as the log tells them.
//!
//! The log is replayed, which gives the scanner's motion over short windows by what it saw; the parameters are those with
//! which the ticks say the same, by robust least squares over all windows. As the replay itself leans on the ticks, it is
//! repeated with the new parameters until they stay. Uncertainties are those of the windows' scatter, taken over blocks of
//! neighbouring windows, whose errors hang together, and of what remained on simulated drives.
//!
//! Reference: Censi et al., "Simultaneous calibration of odometry and sensor parameters for mobile robots" (2013), who show
//! that these parameters can be told by driving alone.

use std::path::Path;

use nalgebra::{Isometry2, SMatrix, SVector, Vector2, Vector3};
use slam_core::SlamConfig;
use slam_core::odometry::wheel_faults::WheelFault;
use slam_core::tracking::correction::Verdict;
use toml_edit::{DocumentMut, value};

use crate::log::{Log, Odometry};
use crate::replay::{self, ReplayError, Step};
use crate::robot::{Robot, Wheels};
use crate::toml_file::{self, FileError};

/// Number of parameters.
const N: usize = 7;
type Vector = SVector<f64, N>;
type Matrix = SMatrix<f64, N, N>;

/// Scans of a window.
const WINDOW: usize = 5;
/// Windows whose errors hang together.
const BLOCK: usize = 4;
/// Fewest windows that say anything.
const LEAST_WINDOWS: usize = 20;
/// Windows in which the scanner moved less than this say nothing, metres and radians alike.
const LEAST_MOTION: f64 = 0.01;
/// Most replays.
pub const ROUNDS: usize = 8;
/// Replays end when no parameter moves by more than this share of its uncertainty.
const SETTLED: f64 = 0.1;
/// The odometry is trusted so many times less than the robot file says while it is being calibrated.
const DISTRUST: f32 = 4.0;
/// Steps of the least squares for each replay.
const STEPS: usize = 20;
/// Residuals beyond this many standard deviations count less.
const KERNEL_SIGMAS: f64 = 2.0;
/// Delays tried at the start: so many times a step, in seconds.
const DELAYS: std::ops::RangeInclusive<i32> = -20..=40;
const DELAY_STEP_S: f64 = 0.01;

/// One parameter of the robot.
#[derive(Clone, Debug)]
pub struct Parameter {
    /// Table and key in the robot file.
    pub key: [&'static str; 2],
    /// What the file says, in its unit.
    pub before: f64,
    /// What the log says.
    pub value: f64,
    /// Standard deviation of that.
    pub sigma: f64,
    /// Whether the log can tell: otherwise the file's value stays.
    pub told: bool,
}

/// What a log said.
#[derive(Clone, Debug)]
pub struct Calibration {
    /// Radii, track, delay, mounting.
    pub parameters: Vec<Parameter>,
    /// Windows in which the scanner's motion was compared.
    pub windows: usize,
    /// The robot file with what was told, all else as it was.
    pub robot_file: String,
}

/// Why a robot could not be calibrated.
#[derive(Debug, thiserror::Error)]
pub enum CalibrationError {
    /// The robot file cannot be used.
    #[error(transparent)]
    Robot(#[from] FileError),
    /// The log cannot be replayed.
    #[error(transparent)]
    Replay(#[from] ReplayError),
    /// No ticks.
    #[error("the log brings poses, not wheel ticks or angles: there is nothing to calibrate")]
    NoTicks,
    /// Wheels or encoders are not as the robot file says.
    #[error("{}: mend it, or the robot file, before calibrating; nothing is written", fault.message())]
    WheelFault {
        /// What is wrong.
        fault: WheelFault,
    },
    /// Hardly any window in which the scanner's motion is known.
    #[error(
        "the scanner's motion is known in {windows} windows of {WINDOW} scans, {LEAST_WINDOWS} are needed: \
         drive among more walls, or longer"
    )]
    TooShort {
        /// Windows found.
        windows: usize,
    },
}

/// A parameter's place in the file and what can be said of it beforehand.
struct Kind {
    key: [&'static str; 2],
    /// The file's unit in that of the parameter.
    unit: f64,
    /// Standard deviation beforehand; a share of the value for radii and track.
    before: f64,
    /// Standard deviation up to which the log has told it; a share likewise.
    told: f64,
    /// Error that no scatter shows, as found on simulated drives, whose truth is known; a share likewise. Scanner and ticks are
    /// sampled at different instants, and the replay leans on what is being calibrated.
    systematic: f64,
    relative: bool,
}

const RADIUS: Kind =
    Kind { key: ["wheels", ""], unit: 1.0, before: 0.05, told: 0.01, systematic: 0.002, relative: true };
const METRES: Kind =
    Kind { key: ["mounting", ""], unit: 1.0, before: 0.2, told: 0.02, systematic: 0.003, relative: false };
const KINDS: [Kind; N] = [
    Kind { key: ["wheels", "left_radius_m"], ..RADIUS },
    Kind { key: ["wheels", "right_radius_m"], ..RADIUS },
    Kind { key: ["wheels", "track_m"], before: 0.2, told: 0.02, systematic: 0.005, ..RADIUS },
    Kind { key: ["sensor", "scan_delay_s"], before: 0.3, ..METRES },
    Kind { key: ["mounting", "x_m"], ..METRES },
    Kind { key: ["mounting", "y_m"], ..METRES },
    Kind { key: ["mounting", "yaw_deg"], unit: std::f64::consts::PI / 180.0, systematic: 0.0005, ..METRES },
];

impl Kind {
    fn sigma_before(&self, value: f64) -> f64 {
        if self.relative { self.before * value.abs() } else { self.before }
    }

    fn sigma_systematic(&self, value: f64) -> f64 {
        if self.relative { self.systematic * value.abs() } else { self.systematic }
    }

    fn is_told(&self, value: f64, sigma: f64) -> bool {
        sigma <= if self.relative { self.told * value.abs() } else { self.told }
    }
}

/// Calibrates the robot of a file by a log. `progress` is called after each replay.
pub fn calibrate(
    log: &Log,
    robot_path: &Path,
    mut progress: impl FnMut(),
) -> Result<Calibration, CalibrationError> {
    let text = toml_file::read(robot_path)?;
    let robot = Robot::parse(&text, robot_path)?;
    let wheels = robot.wheels.ok_or_else(|| ReplayError::NoWheels { robot: robot.name.clone() })?;
    // The text has just been parsed.
    let mut document: DocumentMut = text.parse().expect("what serde reads, the editor reads");
    let ticks = WheelTurns::new(log, wheels).ok_or(CalibrationError::NoTicks)?;
    let before = Vector::from_fn(|i, _| number_in(&document, KINDS[i].key) * KINDS[i].unit);
    let mut now = Estimate { value: before, sigma: Vector::repeat(f64::INFINITY), windows: 0 };
    for round in 0..ROUNDS {
        let robot = Robot::parse(&document.to_string(), robot_path)?;
        let windows = windows(log, &robot, &now.value)?;
        progress();
        let last = now.value;
        if round == 0 {
            now.value[3] = best_delay(&now.value, &windows, &ticks);
        }
        now = estimate(&before, &now.value, &windows, &ticks);
        for (i, kind) in KINDS.iter().enumerate() {
            set_number(&mut document, kind.key, now.value[i] / kind.unit);
        }
        if (now.value - last).component_div(&now.sigma).amax() < SETTLED {
            break;
        }
    }
    let parameters: Vec<Parameter> = KINDS
        .iter()
        .enumerate()
        .map(|(i, kind)| {
            let sigma = now.sigma[i].hypot(kind.sigma_systematic(now.value[i]));
            Parameter {
                key: kind.key,
                before: before[i] / kind.unit,
                value: now.value[i] / kind.unit,
                sigma: sigma / kind.unit,
                told: kind.is_told(now.value[i], sigma),
            }
        })
        .collect();
    for parameter in &parameters {
        let kept = if parameter.told { parameter.value } else { parameter.before };
        set_number(&mut document, parameter.key, kept);
    }
    // What was written must be a robot file too, wherever it will lie.
    for table in ["sensor", "odometry_noise"] {
        set_absolute_profile(&mut document, table, robot_path);
    }
    Robot::parse(&document.to_string(), robot_path)?;
    Ok(Calibration { parameters, windows: now.windows, robot_file: document.to_string() })
}

fn number_in(document: &DocumentMut, [table, key]: [&str; 2]) -> f64 {
    let item = &document[table][key];
    item.as_float().or_else(|| item.as_integer().map(|v| v as f64)).unwrap_or(0.0)
}

/// Names a profile that is a file in such a way that it is found from everywhere.
fn set_absolute_profile(document: &mut DocumentMut, table: &str, robot_path: &Path) {
    let Some(item) = document.get_mut(table).and_then(|table| table.get_mut("profile")) else { return };
    let Some(name) = item.as_str().filter(|name| name.ends_with(".toml")) else { return };
    let path = robot_path.parent().unwrap_or(Path::new("")).join(name);
    if let Ok(path) = path.canonicalize() {
        *item = value(path.to_string_lossy().into_owned());
    }
}

/// Sets a number to six digits, the comment beside it kept.
fn set_number(document: &mut DocumentMut, [table, key]: [&str; 2], number: f64) {
    let item = &mut document[table][key];
    let decor = item.as_value().map(|v| v.decor().clone());
    *item = value((number * 1e6).round() / 1e6);
    if let (Some(value), Some(decor)) = (item.as_value_mut(), decor) {
        *value.decor_mut() = decor;
    }
}

/// How far each wheel had turned, radians, at each stamp.
struct WheelTurns {
    samples: Vec<(f64, [f64; 2])>,
}

impl WheelTurns {
    /// `None` where the log brings no ticks.
    fn new(log: &Log, wheels: Wheels) -> Option<Self> {
        let per_tick = 2.0 * std::f64::consts::PI / f64::from(wheels.ticks_per_turn);
        let mut turns = [0.0; 2];
        let mut last: Option<[i64; 2]> = None;
        let mut samples = Vec::with_capacity(log.odometry.len());
        for (stamp_us, odometry) in &log.odometry {
            match odometry {
                Odometry::Ticks(ticks) => {
                    let before = last.replace(*ticks).unwrap_or(*ticks);
                    for (turn, moved) in turns.iter_mut().zip(wheels.ticks_between(before, *ticks)) {
                        *turn += f64::from(moved) * per_tick;
                    }
                }
                Odometry::Angles(angles) => turns = *angles,
                Odometry::Pose(_) => return None,
            }
            samples.push((*stamp_us as f64 * 1e-6, turns));
        }
        (!samples.is_empty()).then_some(Self { samples })
    }

    fn at(&self, stamp_s: f64) -> [f64; 2] {
        let after =
            self.samples.partition_point(|(s, _)| *s < stamp_s).clamp(1, self.samples.len().max(2) - 1);
        let (Some((t0, from)), Some((t1, to))) = (self.samples.get(after - 1), self.samples.get(after))
        else {
            return self.samples[0].1;
        };
        let share = ((stamp_s - t0) / (t1 - t0)).clamp(0.0, 1.0);
        [0, 1].map(|side| from[side] + share * (to[side] - from[side]))
    }

    /// Motion of the base between two instants, for radii and track.
    fn motion(&self, [left, right, track]: [f64; 3], from_s: f64, to_s: f64) -> Isometry2<f64> {
        let between = |t: f64| t > from_s && t < to_s;
        let first = self.samples.partition_point(|(s, _)| *s <= from_s);
        let inner = self.samples.iter().skip(first).map(|(s, _)| *s).take_while(|s| between(*s));
        let mut motion = Isometry2::identity();
        let mut last = self.at(from_s);
        for stamp_s in inner.chain([to_s]) {
            let now = self.at(stamp_s);
            let [l, r] = [left * (now[0] - last[0]), right * (now[1] - last[1])];
            let (way, turn) = (0.5 * (l + r), (r - l) / track);
            // The chord of an arc lies along its middle heading; short arcs are as long as their chords.
            let half = 0.5 * turn;
            let chord = if half.abs() > 1e-6 { way * half.sin() / half } else { way };
            motion *= Isometry2::new(Vector2::new(chord * half.cos(), chord * half.sin()), turn);
            last = now;
        }
        motion
    }
}

/// Motion of the scanner between two scans, as it saw it.
struct Window {
    from_s: f64,
    to_s: f64,
    motion: Isometry2<f64>,
}

impl Window {
    /// What the ticks say, against what the scanner saw: forward and left, metres, and turn, radians.
    fn residual(&self, p: &Vector, ticks: &WheelTurns) -> Vector3<f64> {
        let base_from_laser = Isometry2::new(Vector2::new(p[4], p[5]), p[6]);
        let base = ticks.motion([p[0], p[1], p[2]], self.from_s - p[3], self.to_s - p[3]);
        let said = base_from_laser.inverse() * base * base_from_laser;
        let off = said.inv_mul(&self.motion);
        Vector3::new(off.translation.x, off.translation.y, off.rotation.angle())
    }
}

/// The windows of a replay in which every scan fixed the pose.
fn windows(log: &Log, robot: &Robot, p: &Vector) -> Result<Vec<Window>, CalibrationError> {
    let looser = Robot { odometry_noise: robot.odometry_noise.times(DISTRUST), ..robot.clone() };
    let replay = replay::run(log, &looser, SlamConfig::default(), || {})?;
    // For most of the drive, or at its end: some seconds of slip are no fault.
    let faults = || replay.steps.iter().filter_map(|step| step.update.wheel_fault);
    if let Some(fault) = faults().next_back()
        && 4 * faults().filter(|f| *f == fault).count() > replay.steps.len()
    {
        return Err(CalibrationError::WheelFault { fault });
    }
    let base_from_laser = Isometry2::new(Vector2::new(p[4], p[5]), p[6]);
    let laser = |step: &Step| nalgebra::convert::<_, Isometry2<f64>>(step.pose) * base_from_laser;
    let plain = |step: &Step| {
        let update = &step.update;
        update.corrected && update.closure.is_none() && update.observability.verdict == Verdict::Full
    };
    let found: Vec<Window> = replay
        .steps
        .chunks(WINDOW)
        .zip(replay.steps.chunks(WINDOW).skip(1))
        .filter_map(|(here, next)| {
            let (first, last) = (here.first()?, next.first()?);
            let window = Window {
                from_s: first.stamp_us as f64 * 1e-6,
                to_s: last.stamp_us as f64 * 1e-6,
                motion: laser(first).inv_mul(&laser(last)),
            };
            let moved = window.motion.translation.vector.norm() > LEAST_MOTION
                || window.motion.rotation.angle().abs() > LEAST_MOTION;
            (moved && here.iter().all(plain) && plain(last)).then_some(window)
        })
        .collect();
    if found.len() < LEAST_WINDOWS {
        return Err(CalibrationError::TooShort { windows: found.len() });
    }
    Ok(found)
}

/// Standard deviations of the residuals' components, by their medians.
fn scales(p: &Vector, windows: &[Window], ticks: &WheelTurns) -> Vector3<f64> {
    let residuals: Vec<Vector3<f64>> = windows.iter().map(|w| w.residual(p, ticks)).collect();
    Vector3::from_fn(|i, _| {
        let mut sizes: Vec<f64> = residuals.iter().map(|r| r[i].abs()).collect();
        sizes.sort_unstable_by(f64::total_cmp);
        // The median of |x| of a Gaussian is 0.6745 σ.
        (sizes[sizes.len() / 2] / 0.6745).max(1e-4)
    })
}

/// The delay with which the ticks agree best, all else as it is: where the least squares may start.
fn best_delay(p: &Vector, windows: &[Window], ticks: &WheelTurns) -> f64 {
    let misfit = |delay_s: f64| {
        let mut p = *p;
        p[3] = delay_s;
        // The turns tell it; their median misfit is blind to bad windows.
        scales(&p, windows, ticks)[2]
    };
    let delays = DELAYS.map(|k| f64::from(k) * DELAY_STEP_S);
    delays.min_by(|a, b| misfit(*a).total_cmp(&misfit(*b))).unwrap_or(p[3])
}

struct Estimate {
    value: Vector,
    sigma: Vector,
    windows: usize,
}

/// The parameters that make ticks and scanner agree, from `start`, with a weak pull towards `before`.
fn estimate(before: &Vector, start: &Vector, windows: &[Window], ticks: &WheelTurns) -> Estimate {
    let mut p = *start;
    let prior = Vector::from_fn(|i, _| KINDS[i].sigma_before(before[i]).powi(-2));
    let mut covariance = Matrix::identity();
    for _ in 0..STEPS {
        let scale = scales(&p, windows, ticks);
        let mut normal = Matrix::from_diagonal(&prior);
        let mut right = prior.component_mul(&(before - p));
        let mut gradients: Vec<Vector> = Vec::new();
        for (k, window) in windows.iter().enumerate() {
            let residual = window.residual(&p, ticks);
            let jacobian = SMatrix::<f64, 3, N>::from_columns(&[0, 1, 2, 3, 4, 5, 6].map(|i| {
                let h = 1e-4;
                let mut q = p;
                q[i] += h;
                (residual - window.residual(&q, ticks)) / h
            }));
            let weights = Vector3::from_fn(|i, _| {
                let sigmas = residual[i] / (KERNEL_SIGMAS * scale[i]);
                1.0 / (scale[i] * scale[i] * (1.0 + sigmas * sigmas))
            });
            let weighed = jacobian.transpose() * nalgebra::Matrix3::from_diagonal(&weights);
            normal += weighed * jacobian;
            let gradient = weighed * residual;
            right += gradient;
            if k % BLOCK == 0 {
                gradients.push(Vector::zeros());
            }
            if let Some(block) = gradients.last_mut() {
                *block += gradient;
            }
        }
        let Some(inverse) = normal.try_inverse() else { break };
        let step = inverse * right;
        p += step;
        let scatter: Matrix = gradients.iter().map(|g| g * g.transpose()).sum();
        // The scatter of the blocks, and what was known beforehand.
        covariance = inverse * (scatter + Matrix::from_diagonal(&prior)) * inverse;
        if step.component_div(&covariance.diagonal().map(f64::sqrt)).amax() < 1e-3 {
            break;
        }
    }
    Estimate { value: p, sigma: covariance.diagonal().map(f64::sqrt), windows: windows.len() }
}
