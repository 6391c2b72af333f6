//! Starts the board and spawns the tasks.

use defmt_rtt as _;
use embassy_executor::Spawner;
use embassy_sync::blocking_mutex::raw::CriticalSectionRawMutex;
use embassy_sync::zerocopy_channel::Channel;
use static_cell::StaticCell;

use crate::kept::{Found, Keeper, KeptTicks, Mapper, ROOM};
use crate::lidar::ScanBuffer;
use crate::trace::Tracer;
use crate::{board, console, encoders, faults, lidar, mapping, robot, signs};

#[embassy_executor::main]
async fn main(spawner: Spawner) {
    let (mut board, cause) = board::start();
    defmt::info!(
        "lineslam {=str} on {=str}, robot {=str}; room for {=usize} segments and {=usize} places, {=usize} bytes of map and odometry",
        env!("CARGO_PKG_VERSION"),
        board::NAME,
        robot::NAME,
        ROOM[0],
        ROOM[1],
        Mapper::BYTES
    );
    defmt::info!("reset by {}", cause);
    faults::report();
    #[cfg(feature = "sleeps")]
    sleeps().await;
    board.watchdog.unleash();
    let (keeper, found) = match Keeper::take() {
        Ok(kept) => kept,
        Err(error) => {
            defmt::error!("the configuration cannot be used: {}", error);
            return;
        }
    };
    match found {
        Found::Map | Found::HalfDone => {}
        Found::Nothing | Found::Damaged => defmt::info!("a new map begins; kept memory: {}", found),
    }
    let ticks = KeptTicks::take(!matches!(found, Found::Map | Found::HalfDone));

    static BUFFERS: StaticCell<[ScanBuffer; 2]> = StaticCell::new();
    static SCANS: StaticCell<Channel<'static, CriticalSectionRawMutex, ScanBuffer>> = StaticCell::new();
    let buffers = BUFFERS.init([ScanBuffer::EMPTY, ScanBuffer::EMPTY]);
    let (sender, receiver) = SCANS.init(Channel::new(buffers)).split();

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
        mapping::run(keeper, found, Tracer::take(), receiver, board.watchdog),
        signs::run(board.led, board.button),
    ) {
        (Ok(mapping), Ok(signs)) => {
            spawner.spawn(mapping);
            spawner.spawn(signs);
        }
        _ => defmt::error!("a task cannot be spawned"),
    }
    if let Some(Ok(console)) = board.console.open().map(console::run) {
        spawner.spawn(console);
    }
    #[cfg(feature = "sleeps")]
    if let Ok(last_words) = last_words() {
        spawner.spawn(last_words);
    }
}

/// Sleeps a thousand times, 1 µs to 200 ms, and says how late it woke at the latest.
#[cfg(feature = "sleeps")]
async fn sleeps() {
    use embassy_time::{Instant, Timer};
    let mut latest_us = 0;
    for k in 0..1000u64 {
        let end = Instant::now() + embassy_time::Duration::from_micros(1 + k * 7_919 % 199_990);
        Timer::at(end).await;
        latest_us = latest_us.max((Instant::now() - end).as_micros());
    }
    defmt::info!("slept 1000 times; woke at the latest {=u64} us after the end", latest_us);
}

/// Panics after twenty seconds.
#[cfg(feature = "sleeps")]
#[embassy_executor::task]
async fn last_words() {
    embassy_time::Timer::after_secs(20).await;
    panic!("as this build is told to");
}
