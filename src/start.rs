//! Starts the board and spawns the tasks.

use embassy_executor::Spawner;
use embassy_sync::blocking_mutex::raw::CriticalSectionRawMutex;
use embassy_sync::zerocopy_channel::Channel;
use static_cell::StaticCell;

use crate::board::{ClockSource, ResetCause};
use crate::kept::{Found, Keeper, KeptTicks, Mapper, ROOM};
use crate::lidar::ScanBuffer;
use crate::link::{Frame, Outbox};
use crate::resets::Count;
use crate::trace::Tracer;
use crate::{board, encoders, faults, lidar, link, liveness, mapping, resets, robot, signs};

#[embassy_executor::main]
async fn main(spawner: Spawner) {
    let watchdog = board::guard(liveness::UNFED_US);
    let cause = board::reset_cause();
    resets::begin(cause);
    let (board, clock) = board::start(Count::ClockLost.read() == 0);
    defmt::info!(
        "lineslam {=str} on {=str}, robot {=str}; room for {=usize} segments and {=usize} places, {=usize} bytes of map and odometry",
        env!("CARGO_PKG_VERSION"),
        board::NAME,
        robot::NAME,
        ROOM[0],
        ROOM[1],
        Mapper::BYTES
    );
    report(cause, clock);
    #[cfg(feature = "sleeps")]
    let watchdog = sleeps(watchdog).await;
    let refused = match cause {
        ResetCause::Power => Some(Found::PowerWasAway),
        _ if Count::Early.read() >= resets::GIVE_UP_AFTER => Some(Found::GivenUp),
        _ => None,
    };
    let (keeper, found) = match Keeper::take(refused) {
        Ok(kept) => kept,
        Err(error) => {
            defmt::error!("the configuration cannot be used: {}", error);
            return;
        }
    };
    if found == Found::GivenUp {
        defmt::error!(
            "the firmware failed early {=u32} times running: the kept map is given up",
            Count::Early.read()
        );
        Count::Early.set(0);
    }
    if !found.is_map() {
        defmt::info!("a new map begins; kept memory: {}", found);
    }
    let ticks = KeptTicks::take(!found.is_map());

    static BUFFERS: StaticCell<[ScanBuffer; 2]> = StaticCell::new();
    static SCANS: StaticCell<Channel<'static, CriticalSectionRawMutex, ScanBuffer>> = StaticCell::new();
    let buffers = BUFFERS.init([ScanBuffer::EMPTY, ScanBuffer::EMPTY]);
    let (sender, receiver) = SCANS.init(Channel::new(buffers)).split();

    static FRAME: StaticCell<[Frame; 1]> = StaticCell::new();
    static FRAMES: StaticCell<Channel<'static, CriticalSectionRawMutex, Frame>> = StaticCell::new();
    // Where it is to stay: a task's arguments are there twice.
    static OUTBOX: StaticCell<Outbox> = StaticCell::new();
    let (frames, to_send) = FRAMES.init(Channel::new(FRAME.init([Frame::EMPTY]))).split();
    let outbox = OUTBOX.init(Outbox::new(frames, cause.into(), found.into()));

    let urgent = board::urgent();
    // Each task is spawned once, so there is room for it.
    match (encoders::run(board.encoders, ticks), lidar::run(board.lidar, sender)) {
        (Ok(encoders), Ok(lidar)) => {
            urgent.spawn(encoders);
            urgent.spawn(lidar);
        }
        _ => defmt::error!("an urgent task cannot be spawned"),
    }
    match (
        mapping::run(keeper, found, Tracer::take(), outbox, receiver),
        signs::run(board.led, board.button),
        liveness::run(watchdog),
    ) {
        (Ok(mapping), Ok(signs), Ok(liveness)) => {
            spawner.spawn(mapping);
            spawner.spawn(signs);
            spawner.spawn(liveness);
        }
        _ => defmt::error!("a task cannot be spawned"),
    }
    match board.vcp.open().map(|(tx, rx)| (link::send(tx, to_send), link::receive(rx))) {
        Some((Ok(send), Ok(receive))) => {
            spawner.spawn(send);
            spawner.spawn(receive);
        }
        _ => defmt::error!("the link cannot be opened"),
    }
    #[cfg(feature = "misbehaves")]
    if let Some(Ok(failing)) = found.is_map().then(crate::orders::fail_with_map) {
        spawner.spawn(failing);
    }
    #[cfg(feature = "sleeps")]
    if let Ok(last_words) = last_words() {
        spawner.spawn(last_words);
    }
}

/// What is known of the last run's end and of this one's clock.
fn report(cause: ResetCause, clock: ClockSource) {
    defmt::info!("reset by {}", cause);
    faults::report();
    liveness::report(cause);
    defmt::info!("clock: {=u32} MHz from {=str}", board::CORE_HZ / 1_000_000, clock.name());
    if clock == ClockSource::Internal {
        match Count::ClockLost.read() {
            0 => defmt::warn!("the ST-LINK's clock does not come"),
            times => defmt::warn!("the ST-LINK's clock stopped {=u32} times since power-up", times),
        }
        defmt::warn!("times and bit rates are off by 1 % at 25 degrees, by up to 4 % from -10 to 85");
    }
}

/// Sleeps a thousand times, 1 µs to 200 ms, and says how late it woke at the latest.
#[cfg(feature = "sleeps")]
async fn sleeps(mut watchdog: board::Watchdog) -> board::Watchdog {
    use embassy_time::{Instant, Timer};
    let mut latest_us = 0;
    for k in 0..1000u64 {
        let end = Instant::now() + embassy_time::Duration::from_micros(1 + k * 7_919 % 199_990);
        Timer::at(end).await;
        latest_us = latest_us.max((Instant::now() - end).as_micros());
        watchdog.pet();
    }
    defmt::info!("slept 1000 times; woke at the latest {=u64} us after the end", latest_us);
    watchdog
}

/// Panics after twenty seconds.
#[cfg(feature = "sleeps")]
#[embassy_executor::task]
async fn last_words() {
    embassy_time::Timer::after_secs(20).await;
    panic!("as this build is told to");
}
