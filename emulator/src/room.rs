//! The world around the board: a building, a base that drives through it, the sensor, and the encoders' edges.

use std::collections::VecDeque;

use lineslam::robot::Robot;
use lineslam::sim::base::Base;
use lineslam::sim::scanner::{Moment, Scanner};
use lineslam::sim::world::World;
use lineslam::sim::{SimConfig, config, interpolate};
use nalgebra::Isometry2;
use rigless::chip::uart::Errors;
use rigless::device::Level;
use scip::sim::{Mode, SimulatedUrg, rates_agree};

/// The base is stepped this often, microseconds.
pub const STEP_US: u64 = 1000;
/// The base stands until the sensor has been found.
const PAUSE_S: f64 = 6.0;
/// Poses that are kept where older ones are let go: of ten seconds, more than a scan takes to be sent.
const KEPT_POSES: usize = 10_000;

/// A reply with more bytes than this has a scan in it.
const LEAST_SCAN: usize = 500;

/// A scan as the sensor measured it.
#[derive(Clone, Debug)]
pub struct TrueScan {
    /// When its middle beam was taken, virtual microseconds.
    pub middle_us: u64,
    /// Where `base` was then, in the world.
    pub world_from_base: Isometry2<f64>,
    /// What was sent.
    pub ranges_mm: Vec<u16>,
}

/// A change of an encoder's lines.
#[derive(Clone, Copy, Debug)]
pub struct Edge {
    /// When, virtual nanoseconds.
    pub at_ns: u64,
    /// Left or right wheel.
    pub side: usize,
    /// Levels of both lines after it.
    pub levels: [Level; 2],
}

/// The building and all that moves in it.
pub struct Building {
    world: World,
    base: Base,
    scanner: Scanner,
    first_step: f64,
    steps_per_revolution: f64,
    /// Pose at each step so far, one ahead of now, but for so many of the first.
    poses: Vec<Isometry2<f64>>,
    forgotten: usize,
    ticks: [i64; 2],
    path_m: f64,
    driven_m: f64,
    /// Scans that were sent.
    pub scans: Vec<TrueScan>,
}

impl std::fmt::Debug for Building {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Building({})", self.world.name)
    }
}

impl Building {
    /// A robot at the start of the world's path.
    pub fn new(world: &World, robot: &Robot, sim: &SimConfig, seed: u64) -> anyhow::Result<Self> {
        let mut world = world.clone();
        world.path.pause_s = world.path.pause_s.max(PAUSE_S);
        // 32 bits, so that differences never wrap here; the timers' own 16 do.
        let mut wheels =
            robot.wheels.ok_or_else(|| anyhow::anyhow!("robot '{}' has no wheels", robot.name))?;
        wheels.counter_bits = 32;
        let geometry = robot.config().sensor.geometry;
        // Counters begin again when the board is reset; the encoders' lines know nothing of that.
        let mut sim = *sim;
        sim.fault.restart_at_s = config::NEVER_S;
        let base = Base::new(&world.path, wheels, &sim, seed);
        Ok(Self {
            scanner: Scanner::new(&world, robot, &sim, seed),
            first_step: geometry.first_step.into(),
            steps_per_revolution: geometry.steps_per_revolution.into(),
            path_m: path_length(&world),
            driven_m: 0.0,
            poses: vec![base.pose],
            forgotten: 0,
            ticks: base.ticks(),
            base,
            world,
            scans: Vec::new(),
        })
    }

    /// Whether the end of the path is reached.
    pub fn arrived(&self) -> bool {
        self.base.arrived()
    }

    /// Share of the path that is driven, 0 to 1.
    pub fn driven(&self) -> f64 {
        if self.arrived() { 1.0 } else { (self.driven_m / self.path_m).min(1.0) }
    }

    /// Where `base` is, in the world.
    pub fn pose_at_us(&self, us: f64) -> Isometry2<f64> {
        interpolate(&self.poses, us / STEP_US as f64 - self.forgotten as f64)
    }

    /// Lets all go but the last scans, and the poses of a while. The first scan stays: there the map begins.
    pub fn forget(&mut self, scans: usize) {
        if let Some(last_gone) = self.scans.len().checked_sub(scans).filter(|last| *last > 1) {
            self.scans.drain(1..last_gone);
        }
        let gone = self.poses.len().saturating_sub(KEPT_POSES);
        self.poses.drain(..gone);
        self.forgotten += gone;
    }

    /// Drives to one step beyond now; the encoders' edges on the way.
    pub fn advance(&mut self, now_us: u64, edges: &mut Vec<Edge>) {
        while self.last_step() * STEP_US <= now_us {
            let begin_ns = self.last_step() * STEP_US * 1000;
            let before = self.base.pose.translation.vector;
            self.base.step(STEP_US as f64 * 1e-6);
            self.driven_m += (self.base.pose.translation.vector - before).norm();
            self.poses.push(self.base.pose);
            let ticks = self.base.ticks();
            for (side, (before, after)) in self.ticks.into_iter().zip(ticks).enumerate() {
                let count = before.abs_diff(after);
                for k in 1..=count {
                    let at_ns = begin_ns + (2 * k - 1) * STEP_US * 500 / count;
                    let tick = if after > before { before + k as i64 } else { before - k as i64 };
                    edges.push(Edge { at_ns, side, levels: levels(tick) });
                }
            }
            self.ticks = ticks;
        }
        edges.sort_by_key(|edge| edge.at_ns);
    }

    fn last_step(&self) -> u64 {
        (self.forgotten + self.poses.len()) as u64 - 1
    }

    /// Levels of the encoders' lines now.
    pub fn encoder_levels(&self) -> [[Level; 2]; 2] {
        self.ticks.map(levels)
    }

    /// A scan whose revolution began at that instant and takes so long.
    fn measure(&mut self, begin_us: u64, revolution_us: u64, ranges_mm: &mut [u16]) {
        let beam_us = revolution_us as f64 / self.steps_per_revolution;
        let at = |beam: usize| begin_us as f64 + (self.first_step + beam as f64) * beam_us;
        let middle_us = at(0).midpoint(at(ranges_mm.len() - 1));
        let people = self.world.people_at(middle_us * 1e-6);
        let (poses, forgotten) = (&self.poses, self.forgotten as f64);
        let moment = Moment { time_s: middle_us * 1e-6, carried: self.base.is_carried() };
        let pose = |beam| interpolate(poses, at(beam) / STEP_US as f64 - forgotten);
        let measured = self.scanner.scan(pose, &people, moment);
        ranges_mm.copy_from_slice(&measured);
        let world_from_base = self.pose_at_us(middle_us);
        self.scans.push(TrueScan { middle_us: middle_us as u64, world_from_base, ranges_mm: measured });
    }
}

fn path_length(world: &World) -> f64 {
    let points = &world.path.points;
    points.windows(2).map(|p| (p[1][0] - p[0][0]).hypot(p[1][1] - p[0][1])).sum()
}

/// Lines of a quadrature encoder: A leads B when it counts up.
fn levels(tick: i64) -> [Level; 2] {
    let level = |high| if high { Level::High } else { Level::Low };
    let phase = tick.rem_euclid(4);
    [level(phase == 1 || phase == 2), level(phase >= 2)]
}

/// All of it, with the line between.
#[derive(Debug)]
pub struct Room {
    /// The building.
    pub building: Building,
    /// The sensor.
    pub urg: SimulatedUrg,
    /// Bit rate of the microcontroller's port.
    pub host_rate: u32,
    /// Whether the sensor's plug is in.
    pub plugged: bool,
    /// The virtual COM port.
    pub vcp: Line,
    /// When the last byte of each scan had come over the sensor's line, virtual microseconds.
    pub replies_us: Vec<u64>,
    /// Bytes of the reply that comes, and the last of them.
    reply: (usize, u8),
    /// Draws as the port's own model does which bytes come with noise, where that is not to change them.
    pub flagged: Option<Errors>,
}

/// A serial line: bytes that have crossed it, and bytes that wait to.
#[derive(Debug, Default)]
pub struct Line {
    /// All that the microcontroller has sent.
    pub from_board: Vec<u8>,
    /// How many of these the other end has been told.
    pub told: usize,
    /// How many there were when a frame's last byte had come, and when that was, virtual microseconds.
    pub frames: Vec<(usize, u64)>,
    /// What is sent to it, at the bit rate of its port.
    pub to_board: VecDeque<u8>,
}

impl Room {
    /// The sensor powers up at the beginning.
    pub fn new(building: Building, seed: u64) -> Self {
        Self {
            building,
            urg: SimulatedUrg::new(0, seed),
            host_rate: 0,
            plugged: true,
            vcp: Line::default(),
            replies_us: Vec::new(),
            reply: (0, 0),
            flagged: None,
        }
    }

    /// The sensor has been on for long and streams, at another bit rate than the firmware wants.
    pub fn already_streaming(&mut self, baud_rate: u32, seed: u64) {
        let (faults, quirks) = (self.urg.faults, self.urg.quirks);
        self.urg = SimulatedUrg::found(0, seed, baud_rate, Mode::Streaming);
        (self.urg.faults, self.urg.quirks) = (faults, quirks);
    }

    /// A byte from the microcontroller.
    pub fn to_sensor(&mut self, byte: u8, now_us: u64) {
        if self.plugged {
            self.urg.receive(byte, self.host_rate, now_us);
        }
    }

    /// The next byte that the sensor has sent by now. The port hears nothing where the bit rates differ.
    pub fn from_sensor(&mut self, now_us: u64) -> Option<u8> {
        let Self { building, urg, .. } = self;
        let revolution_us = urg.revolution_us();
        urg.advance(now_us, &mut |begin_us, ranges_mm| building.measure(begin_us, revolution_us, ranges_mm));
        loop {
            let sent = self.urg.transmit(now_us)?;
            if self.plugged && rates_agree(self.host_rate, sent.baud_rate) {
                // What the model of the port will flip is flipped beforehand, so that noise raises its flag on a byte that is right.
                let flipped = self.flagged.as_mut().map_or(0, |errors| errors.next(u8::BITS).flipped);
                let byte = sent.byte ^ flipped as u8;
                self.note_reply(byte, now_us);
                return Some(byte);
            }
        }
    }

    /// A reply ends with an empty line.
    fn note_reply(&mut self, byte: u8, now_us: u64) {
        let (bytes, last) = self.reply;
        if [last, byte] != [b'\n'; 2] {
            self.reply = (bytes + 1, byte);
            return;
        }
        if bytes > LEAST_SCAN {
            self.replies_us.push(now_us);
        }
        self.reply = (0, 0);
    }
}
