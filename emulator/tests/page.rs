//! From end to end: the firmware on the emulated board, its virtual COM port, the server of `lineslam live`, and the page in real
//! Chromium. Pictures for a person to look at are left in `target/tmp/live/`.

#[path = "../../host/tests/live_bench/browser.rs"]
mod browser;
mod common;
#[path = "../../host/tests/live_bench/mod.rs"]
mod live_bench;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use browser::{Browser, DESK};
use common::{elf, robot, says, world};
use emulator::report;
use emulator::run::{Outcome, Plan, Seen, run_with};
use emulator::vcp::{Socket, messages};
use lineslam::link::{Address, MapCopy};
use lineslam::live::robot_source::{self, Emulated};
use lineslam::sim::world::World;
use lineslam::sim::{SimConfig, judge};
use live_bench::Served;
use serde_json::json;

const SEED: u64 = 3;
/// The map is printed, and read, in millimetres along and beside a line.
const PRINTED_M: f64 = 3e-3;
/// The drive is over by then, on a machine that is busy with other things.
const PATIENCE: Duration = Duration::from_secs(240);

/// A line as the page has it: number, ends, sightings, whether it is a wall.
type Row = (u16, [f64; 4], u16, bool);

/// A quarter of the hall, through which the robot drives a few metres.
fn building() -> World {
    let mut world = world("hall_quarter");
    world.path.points = vec![[2.5, 3.4], [6.5, 3.4]];
    world
}

fn drive(socket: Socket, over: Arc<AtomicBool>) -> Outcome {
    let (world, robot, elf) = (building(), robot(), elf("lineslam"));
    let plan = Plan {
        elf: &elf,
        world: &world,
        robot: &robot,
        sim: SimConfig::default(),
        seed: SEED,
        seconds: None,
        faults: Vec::new(),
        cycles: false,
    };
    let see = move |seen| {
        if matches!(seen, Seen::Over) {
            over.store(true, Ordering::Relaxed);
        }
    };
    run_with(&plan, socket, see).unwrap_or_else(|error| panic!("{error:#}"))
}

#[test]
fn the_page_follows_the_firmware_to_the_end_of_its_drive_and_tells_it_what_to_do() {
    let Some(browser) = Browser::open("page of the emulated board", &DESK) else { return };
    let begun = Instant::now();
    let socket = Socket::listen(0, None).unwrap();
    let (hold, address) = (socket.hold(), socket.address().unwrap());
    let over = Arc::new(AtomicBool::new(false));
    let board = std::thread::spawn({
        let over = over.clone();
        move || drive(socket, over)
    });
    let world = building();
    let blueprint = judge::blueprint_from(&world, &world.path.start());
    let emulated = Emulated { title: "emulated".into(), blueprint };
    let source = robot_source::start_emulated(Address::Tcp(address.to_string()), emulated).unwrap();
    let served = Served::new(source);
    browser.goto(&served.url());

    // It stands and has begun a map, above the true walls.
    browser.until("lineslam.model.now.trail.length > 10 && lineslam.model.now.lines.size > 3 && lineslam.model.now.status");
    let truth = browser.eval("return lineslam.model.about.blueprint.length;");
    assert_eq!(truth, json!(world.edges().len()));
    commands_reach_the_firmware(&browser);

    while !over.load(Ordering::Relaxed) {
        assert!(begun.elapsed() < PATIENCE, "the drive takes too long");
        std::thread::sleep(Duration::from_millis(50));
    }
    // From here on the map is the same, and all of it has come once all blocks were said again.
    browser.click("[data-command=freeze]");
    browser.until("lineslam.model.now.status.mapping === false");
    browser.eval("lineslam.stoodAt = lineslam.model.toUs;");
    browser.until("lineslam.model.toUs > lineslam.stoodAt + 5e6");
    browser.screenshot("emulated");
    drop(hold);
    let outcome = board.join().unwrap();
    let notes =
        "lineslam.model.notes.some((note) => JSON.stringify(note).includes('The emulated robot has ended'))";
    browser.until(notes);
    println!(
        "{:.0} s of virtual time, followed in {:.0} s",
        outcome.end_us as f64 * 1e-6,
        begun.elapsed().as_secs_f64()
    );
    assert!(outcome.arrived);
    shows_the_map_of_the_firmware(&browser, &outcome);

    browser.click("[data-command=find_yourself]");
    browser.until("[...document.querySelectorAll('.toast')].some((t) => t.textContent === 'The emulated robot has ended.')");
}

fn commands_reach_the_firmware(browser: &Browser) {
    browser.click("[data-command=freeze]");
    browser.until("lineslam.model.now.status.mapping === false");
    browser.until("!document.querySelector('[data-command=freeze]').disabled");
    browser.click("[data-command=freeze]");
    browser.until("lineslam.model.now.status.mapping === true");
    browser.click("[data-command=forget]");
    browser.until("document.getElementById('confirm').open");
    browser.click("#confirm [value=no]");
    browser.click("[data-command=forget]");
    browser.click("#confirm [value=yes]");
    browser.until(
        "[...document.querySelectorAll('.toast')].some((t) => t.textContent.startsWith('The map is empty'))",
    );
    browser.until("lineslam.model.now.trail.length > 10 && lineslam.model.now.lines.size > 3");
    // A board that was reset sends scans and map only to who asks for them again.
    browser.click("[data-command=restart]");
    browser.click("#confirm [value=yes]");
    browser.until("[...document.querySelectorAll('.toast')].some((t) => t.textContent.startsWith('The board restarts'))");
    browser.eval("lineslam.restartedAt = lineslam.model.now.scan.stamp_us;");
    browser.until("lineslam.model.now.scan.stamp_us > lineslam.restartedAt + 3e6");
}

/// What the page shows after the end, what the firmware printed from its memory when its button was pressed, and what its blocks' checks
/// vouch for are the same.
fn shows_the_map_of_the_firmware(browser: &Browser, outcome: &Outcome) {
    let asked = ["SetMapping(false)", "SetMapping(true)", "Forget"].map(|what| format!("link: {what}: Done"));
    for line in &asked {
        assert!(says(outcome, "INFO", line), "{line}");
    }
    let forgotten = outcome.log.iter().filter(|line| line.text == asked[2]).count();
    assert_eq!(forgotten, 1, "not where it was not meant");

    let rows = browser.eval("return [...lineslam.model.now.lines.values()];");
    let rows: Vec<Row> = serde_json::from_value(rows).unwrap();
    let mut said = MapCopy::default();
    for message in messages(&outcome.vcp) {
        said.take(&message);
    }
    assert!(said.is_whole());
    let close = |a: &[f64; 4], b: [[f32; 2]; 2], within_m: f64| {
        a.iter().zip(b.as_flattened()).all(|(a, b)| (a - f64::from(*b)).abs() < within_m)
    };
    for (slot, line) in said.lines() {
        let (_, ends, hits, wall) = rows.iter().find(|row| row.0 == slot).expect("a line of each slot");
        assert!(close(ends, [line.start_m, line.end_m], 1e-3), "{slot}: {ends:?}, {line:?}");
        assert_eq!((*hits, *wall), (line.hits, line.is_wall), "{slot}");
    }
    assert_eq!(rows.len(), said.lines().count());

    let judged = report::judge(&building(), SEED, outcome).unwrap();
    let walls: Vec<&Row> = rows.iter().filter(|row| row.3).collect();
    for wall in &judged.map {
        let ends = [wall.segment().start, wall.segment().end].map(|end| [end.x, end.y]);
        let [from, to] = ends;
        let is_it = |row: &&&Row| {
            row.2 == wall.hits && (close(&row.1, ends, PRINTED_M) || close(&row.1, [to, from], PRINTED_M))
        };
        assert!(walls.iter().any(|row| is_it(&row)), "{wall:?} is not among {walls:?}");
    }
    println!("{} lines, {} of them walls", rows.len(), walls.len());
    assert_eq!(judged.map.len(), walls.len());
    assert!(walls.len() > 5, "{}", walls.len());
}
