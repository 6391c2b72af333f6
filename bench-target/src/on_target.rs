//! The measurements.

use core::hint::black_box;
use core::mem::MaybeUninit;

use cortex_m::peripheral::DWT;
use defmt_rtt as _;
use nalgebra::{Point2, Vector2};
use panic_probe as _;
use slam_core::capacity::{PLACES, SEGMENTS};
use slam_core::geometry::pose::pose;
use slam_core::geometry::segment::Moments;
use slam_core::odometry::Increment;
use slam_core::odometry::track::SWEEP_KNOTS;
use slam_core::slam::Stage;
use slam_core::tracking::TrackingState;
use slam_core::{MapSegment, Scan, ScanMotion, Segment, Slam, SlamConfig};

/// How the robot moved for a scan: since the scan before, and during it.
struct Motion {
    distance_m: f32,
    turn_rad: f32,
    moved: [f32; 3],
    sweep: [[f32; 3]; SWEEP_KNOTS],
}

include!(concat!(env!("OUT_DIR"), "/set.rs"));

/// The URG-04LX's.
const BEAMS: usize = 682;
/// Segments known at the start of a run.
const KNOWN: [usize; 3] = [50, 200, 500];
/// Wheels that slip: in one of so many scans the odometry is off by this turn, radians, so that the pose must be searched for.
const SLIP_SCANS: usize = 5;
const SLIP_RAD: f32 = 0.4;
/// Scans until a robot is told that it may be anywhere: it has some places by then.
const PLACED_SCANS: usize = 150;
/// Turns of a loop counted by hand.
const TURNS: u32 = 1000;
/// Times that a function is called.
const CALLS: u32 = 64;

#[cortex_m_rt::entry]
fn main() -> ! {
    if let Some(mut core) = cortex_m::Peripherals::take() {
        core.DCB.enable_trace();
        core.DWT.enable_cycle_counter();
    }
    kernels();
    functions();
    for (name, config) in
        [("default", SlamConfig::default as fn() -> SlamConfig), ("paper", SlamConfig::paper)]
    {
        for known in KNOWN {
            run(name, config(), known, Trouble::None);
        }
    }
    for known in KNOWN {
        run("slipping", SlamConfig::default(), known, Trouble::Slips);
    }
    for known in KNOWN {
        run("relocalising", SlamConfig::default(), known, Trouble::Lost);
    }
    defmt::println!("end of benchmark");
    loop {
        cortex_m::asm::wfi();
    }
}

/// What the robot is up against.
#[derive(Clone, Copy, PartialEq)]
enum Trouble {
    /// Nothing.
    None,
    /// Wheels that slip.
    Slips,
    /// It is told again and again that it may be anywhere.
    Lost,
}

/// The fixed set of scans through the core, with so many segments known.
fn run(name: &str, config: SlamConfig, known: usize, trouble: Trouble) {
    static mut SLAM: MaybeUninit<Slam<SEGMENTS, BEAMS, PLACES>> = MaybeUninit::uninit();
    // SAFETY: called from the only thread there is, and never from within itself.
    let place = unsafe { &mut *core::ptr::addr_of_mut!(SLAM) };
    let Ok(slam) = Slam::new_in(place, config) else {
        defmt::error!("the configuration {=str} cannot be used", name);
        return;
    };
    let [x, y, heading] = BEGIN;
    let entries = MAP[..known].iter().map(|(segment, hits)| MapSegment::new(segment, *hits, 0, 0.0));
    slam.take_up(entries, pose(x, y, heading));
    defmt::println!("run {=str} {=usize}", name, known);
    for (k, (ranges_mm, motion)) in RANGES_MM.iter().zip(&MOTIONS).enumerate() {
        let mut motion = scan_motion(motion);
        if trouble == Trouble::Slips && k % SLIP_SCANS == SLIP_SCANS - 1 {
            motion.since_previous.before_from_after *= pose(0.0, 0.0, SLIP_RAD);
            motion.since_previous.turn_rad += SLIP_RAD;
        }
        if trouble == Trouble::Lost && k >= PLACED_SCANS && slam.state() != TrackingState::Lost {
            slam.relocalise();
        }
        let searched = slam.counters().searched;
        let mut cycles = [0u32; Stage::COUNT];
        let mut current = Stage::Prediction;
        let mut since = DWT::cycle_count();
        let update = slam.process_scan_watched(&Scan { ranges_mm }, &motion, &mut |stage| {
            let now = DWT::cycle_count();
            cycles[current as usize] += now.wrapping_sub(since);
            (current, since) = (stage, DWT::cycle_count());
        });
        cycles[current as usize] += DWT::cycle_count().wrapping_sub(since);
        let points = update.deskew.points;
        let keyframe = update.registration.keyframe;
        let segments = slam.map().segments().len();
        let searched = slam.counters().searched > searched || update.relocalisation.is_some();
        defmt::println!(
            "scan {} {=u32} {=bool} {=usize} {=bool}",
            cycles,
            points,
            keyframe,
            segments,
            searched
        );
    }
}

fn scan_motion(motion: &Motion) -> ScanMotion {
    let at = |[x, y, heading]: [f32; 3]| pose(x, y, heading);
    ScanMotion {
        since_previous: Increment {
            before_from_after: at(motion.moved),
            distance_m: motion.distance_m,
            turn_rad: motion.turn_rad,
        },
        middle_from_knot: motion.sweep.map(at),
        // The odometry of the drive is good: nothing is made up for it.
        sweep_share: 0.0,
    }
}

/// Cycles of a piece of work, less what reading the counter costs.
fn count(work: impl FnOnce()) -> u32 {
    let start = DWT::cycle_count();
    let empty = DWT::cycle_count().wrapping_sub(start);
    let start = DWT::cycle_count();
    work();
    DWT::cycle_count().wrapping_sub(start).wrapping_sub(empty)
}

/// Prints what a loop of r0 turns costs. It may change r2, lr, the flags and s0 to s7; r1 points to four words. It begins with a
/// line of the flash.
macro_rules! kernel {
    ($name:literal, $($line:literal),+) => {{
        let words = [0.0f32; 4];
        let counted = count(|| {
            // SAFETY: changes only what is named here, and reads only the words.
            unsafe {
                core::arch::asm!(
                    ".p2align 4", $($line,)+
                    inout("r0") TURNS => _, in("r1") words.as_ptr(), out("r2") _, out("lr") _,
                    out("s0") _, out("s1") _, out("s2") _, out("s3") _,
                    out("s4") _, out("s5") _, out("s6") _, out("s7") _,
                );
            }
        });
        defmt::println!("kernel {=str} {=u32} {=u32}", $name, TURNS, counted);
    }};
}

/// Loops whose instructions and cycles were counted by hand, in `emulator/src/bench.rs`.
fn kernels() {
    kernel!("adds", "2:", "vadd.f32 s0, s0, s1", "vadd.f32 s2, s2, s1", "subs r0, #1", "bne 2b");
    kernel!("dependent", "2:", "vadd.f32 s0, s0, s1", "vadd.f32 s0, s0, s1", "subs r0, #1", "bne 2b");
    kernel!("divisions", "2:", "vdiv.f32 s0, s1, s1", "subs r0, #1", "bne 2b");
    kernel!("multiply", "2:", "vmla.f32 s0, s1, s1", "subs r0, #1", "bne 2b");
    kernel!(
        "loads",
        "2:",
        "ldr r2, [r1]",
        "ldr r2, [r1, #4]",
        "ldr r2, [r1, #8]",
        "vldr s3, [r1, #12]",
        "subs r0, #1",
        "bne 2b"
    );
    kernel!("addresses", "2:", "adds r2, r1, #0", "ldr r2, [r2]", "subs r0, #1", "bne 2b");
    kernel!("lists", "2:", "push {{r4-r7}}", "pop {{r4-r7}}", "subs r0, #1", "bne 2b");
    kernel!("calls", "b 2f", ".p2align 4", "3:", "bx lr", "nop", "2:", "bl 3b", "subs r0, #1", "bne 2b");
    kernel!(
        "lines",
        "2:",
        ".rept 6",
        "vadd.f32 s0, s4, s5",
        "vadd.f32 s1, s4, s5",
        "vadd.f32 s2, s4, s5",
        "vadd.f32 s3, s4, s5",
        ".endr",
        "subs r0, #1",
        "bne 2b"
    );
}

/// Each transcendental function that the core uses or might, of libm or its own, beside micromath's.
fn functions() {
    use micromath::F32Ext;
    let angle = |k: u32| -3.1 + 0.097 * k as f32;
    let wide = |k: u32| f64::from(angle(k));
    let both = |(s, c): (f32, f32)| s + c;
    function("sin", |k| libm::sinf(angle(k)), |k| F32Ext::sin(angle(k)), |k| libm::sin(wide(k)));
    function("cos", |k| libm::cosf(angle(k)), |k| F32Ext::cos(angle(k)), |k| libm::cos(wide(k)));
    function(
        "atan2",
        |k| libm::atan2f(angle(k), angle(k + 7)),
        |k| F32Ext::atan2(angle(k), angle(k + 7)),
        |k| libm::atan2(wide(k), wide(k + 7)),
    );
    function(
        "sin_cos",
        |k| both(slam_core::geometry::math::sin_cos(angle(k))),
        |k| both(F32Ext::sin_cos(angle(k))),
        |k| libm::sin(wide(k)) + libm::cos(wide(k)),
    );
    function(
        "sqrt",
        |k| slam_core::geometry::math::sqrt(k as f32),
        |k| F32Ext::sqrt(k as f32),
        |k| libm::sqrt(f64::from(k)),
    );
}

fn function(
    name: &str,
    ours: impl Fn(u32) -> f32,
    micromath: impl Fn(u32) -> f32,
    exact: impl Fn(u32) -> f64,
) {
    let cycles = |f: &dyn Fn(u32) -> f32| {
        count(|| {
            for k in 0..CALLS {
                black_box(f(black_box(k)));
            }
        })
    };
    let around = cycles(&|k| k as f32);
    let each = |f: &dyn Fn(u32) -> f32| cycles(f).saturating_sub(around) / CALLS;
    let error = |f: &dyn Fn(u32) -> f32| {
        (0..CALLS).map(|k| (f64::from(f(k)) - exact(k)).abs()).fold(0.0, f64::max) as f32
    };
    defmt::println!(
        "function {=str} {=u32} {=u32} {=f32} {=f32}",
        name,
        each(&ours),
        each(&micromath),
        error(&ours),
        error(&micromath)
    );
}
