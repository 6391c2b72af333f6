//! The page of `lineslam live` in real Chromium. Pictures for a person to look at are left in `target/tmp/live/`.

#[path = "live_bench/browser.rs"]
mod browser;
mod live_bench;

use std::io::{Read, Write};
use std::net::TcpListener;
use std::time::Duration;

use browser::{Browser, DESK, Window};
use lineslam::configuration::Configuration;
use lineslam::live::source::{
    About, Command, Feed, Kind, Line, PathPoint, Playback, Pose, Scan, What, channel,
};
use lineslam::replay;
use live_bench::{Served, drive, robot, simulated};
use serde_json::{Value, json};
use slam_core::geometry::pose::components;
use slam_core::tracking::TrackingState;

/// Pixels of the map that are about of a colour of the theme.
fn pixels(browser: &Browser, colour: &str) -> u64 {
    let script = r#"
        const probe = document.createElement("span");
        probe.style.color = "var(--COLOUR)";
        document.body.append(probe);
        const of = getComputedStyle(probe).color.match(/[\d.]+/g).slice(0, 3).map(Number);
        probe.remove();
        const canvas = document.getElementById("map");
        const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
        let count = 0;
        for (let k = 0; k < data.length; k += 4) {
            if (Math.abs(data[k] - of[0]) + Math.abs(data[k + 1] - of[1]) + Math.abs(data[k + 2] - of[2]) < 24) count += 1;
        }
        return count;"#;
    browser.eval(&script.replace("COLOUR", colour)).as_u64().unwrap()
}

/// How many pixels of each colour are there at least, for a map that is drawn.
const DRAWN: [(&str, u64); 5] = [("wall", 400), ("path", 100), ("scan", 30), ("robot", 20), ("truth", 500)];

fn is_drawn(browser: &Browser) {
    // What has come is drawn with the next frame.
    is_redrawn(browser);
    for (colour, least) in DRAWN {
        let count = pixels(browser, colour);
        assert!(count > least, "{count} pixels of {colour}");
    }
}

#[test]
fn a_simulated_drive_is_drawn_followed_to_its_end_and_scrubbed() {
    let Some(browser) = Browser::open("live_browser", &DESK) else { return };
    let served = Served::new(simulated(Some(8.0)).start().unwrap());
    browser.goto(&served.url());
    browser.until("lineslam.model.now.trail.length > 120 && lineslam.model.now.lines.size > 5");
    is_drawn(&browser);
    browser.click("#follow");
    browser.until("lineslam.camera.mode === 'follow' && Math.hypot(lineslam.camera.x - lineslam.model.now.pose.at[0], lineslam.camera.y - lineslam.model.now.pose.at[1]) < 0.5");
    browser.screenshot("following");
    assert_eq!(browser.eval("return document.getElementById('state').textContent;"), json!("Tracking"));

    // To the end, as fast as it goes.
    browser.eval("lineslam.link.order({ pace: { speed: null } });");
    browser.until("lineslam.model.playback.ended");
    browser.click("#fit");
    let (_, drive) = drive();
    let replay = replay::run(&drive.log, &robot(), Configuration::Default.config(), || ()).unwrap();
    let last = replay.steps.last().unwrap();
    let expected = components(&last.pose);
    let pose: [f64; 3] = serde_json::from_value(browser.eval("return lineslam.model.now.pose.at;")).unwrap();
    for (own, expected) in pose.iter().zip(expected.iter()) {
        assert!((own - f64::from(*expected)).abs() < 1e-3, "{pose:?} {expected:?}");
    }
    let walls = browser.eval("return lineslam.model.now.walls().length;");
    assert_eq!(walls, json!(replay.map.len()));
    assert_eq!(browser.eval("return lineslam.model.now.trail.length;"), json!(replay.steps.len()));
    browser.until("Math.abs(lineslam.camera.x) > 0 && document.getElementById('time').textContent === document.getElementById('length').textContent");
    is_drawn(&browser);
    assert!(browser.screenshot("desk-light") > 20_000);

    // Back to the middle: the map is smaller there, and the page says that it looks back.
    browser.eval(
        "const s = document.getElementById('scrub'); s.value = 400; s.dispatchEvent(new Event('input'));",
    );
    let then = browser.until("lineslam.model.then?.trail.length").as_u64().unwrap() as usize;
    assert!((replay.steps.len() / 3..replay.steps.len() / 2).contains(&then), "{then}");
    browser.until("document.getElementById('notice').textContent.startsWith('Looking back')");
    browser.screenshot("looking-back");
    // It plays on to the end by itself.
    browser.eval(
        "const s = document.getElementById('speed'); s.value = '30'; s.dispatchEvent(new Event('change'));",
    );
    browser.click("#play");
    browser.until("lineslam.model.atUs === null && document.getElementById('notice').hidden");

    // The other theme, with the layers' menu.
    browser.click("#theme");
    browser.click("#layers");
    is_drawn(&browser);
    browser.screenshot("desk-dark");
    assert_eq!(browser.eval("return document.documentElement.dataset.theme;"), json!("dark"));
    let walls = pixels(&browser, "wall");
    browser.click("[data-layer=walls]");
    is_redrawn(&browser);
    assert!(pixels(&browser, "wall") < walls / 2, "walls are hidden");
    browser.click("[data-layer=walls]");
    saves(&browser, replay.map.len());
}

/// Waits for a frame that began later.
fn is_redrawn(browser: &Browser) {
    let frames =
        browser.eval("const n = lineslam.counts.frames; lineslam.redraw(); return n;").as_u64().unwrap();
    browser.until(&format!("lineslam.counts.frames > {frames}"));
}

/// The three files, read by what knows nothing of the page.
fn saves(browser: &Browser, walls: usize) {
    let name = browser.eval("return lineslam.model.about.title.replace(/[^\\w.-]+/g, '_');");
    let name = name.as_str().unwrap();
    for kind in ["svg", "png", "dxf"] {
        browser.click("#save");
        browser.click(&format!("[data-save={kind}]"));
        let bytes = browser.downloaded(&format!("{name}.{kind}"));
        match kind {
            "svg" => {
                let text = String::from_utf8(bytes).unwrap();
                assert!(text.starts_with("<svg") && text.ends_with("</svg>"), "{text}");
                let drawn = text.matches('M').count();
                assert!(drawn >= walls, "{drawn} strokes for {walls} walls");
            }
            "png" => assert!(bytes.starts_with(b"\x89PNG") && bytes.len() > 20_000),
            _ => {
                let drawing = dxf::Drawing::load(&mut std::io::Cursor::new(bytes)).unwrap();
                assert_eq!(drawing.entities().count(), walls + 1);
            }
        }
    }
}

#[test]
fn the_page_survives_the_servers_restart_and_says_what_is_old() {
    let Some(browser) = Browser::open("live_browser, restart", &DESK) else { return };
    let served = Served::new(simulated(Some(0.0)).start().unwrap());
    let address = served.address;
    browser.goto(&served.url());
    browser.until("lineslam.link.connected && lineslam.model.about");
    browser.eval("lineslam.mark = 'the same page'; lineslam.link.order({ pace: { speed: 20 } });");
    browser.until("lineslam.model.now.trail.length > 60");
    drop(served);
    let words = browser
        .until("!document.getElementById('notice').hidden && document.getElementById('notice').textContent");
    assert!(words.as_str().unwrap().contains("No connection to lineslam"), "{words}");
    browser.until("document.getElementById('notice').textContent.includes('old')");
    browser.screenshot("connection-lost");
    let (done, words) = order(&browser, &json!("freeze"));
    assert!(!done && words.contains("no connection"), "{words}");

    let _served = Served::at(address, simulated(None).start().unwrap());
    browser.until("lineslam.link.connected && lineslam.model.playback.ended");
    browser.until("document.getElementById('notice').hidden");
    assert_eq!(browser.eval("return lineslam.mark;"), json!("the same page"));
    let (_, drive) = drive();
    assert_eq!(browser.eval("return lineslam.model.now.trail.length;"), json!(drive.log.scans.len()));
}

fn order(browser: &Browser, command: &Value) -> (bool, String) {
    browser.eval(&format!(
        "lineslam.answer = null; lineslam.link.order({command}).then((a) => {{ lineslam.answer = a; }});"
    ));
    let answer = browser.until("lineslam.answer");
    (answer["done"].as_bool().unwrap(), answer["words"].as_str().unwrap().to_owned())
}

/// A robot that does what it is told, and hands on what that was.
fn obedient() -> (Served, std::sync::mpsc::Receiver<Command>) {
    let (served, feed) = robot_source(Vec::new());
    let (told, heard) = std::sync::mpsc::channel();
    std::thread::spawn(move || {
        let at = |x: f32| Pose {
            at: [x, 0.0, 0.3],
            covariance: [0.01, 0.0, 0.0, 0.02, 0.0, 0.01],
            state: TrackingState::Tracking,
        };
        for stamp in 0..40u64 {
            let _ = feed.send(stamp * 100_000, What::Pose(at(stamp as f32 * 0.1)));
        }
        let wall = Line { id: 0, ends: [-1.0, 1.0, 5.0, 1.0], hits: 30, wall: true };
        let _ = feed.send(4_000_000, What::Lines { changed: vec![wall], removed: vec![] });
        while let Ok(Some(order)) = feed.order(None) {
            let _ = told.send(order.command);
            order.answer(Ok("It is done.".into()));
        }
    });
    (served, heard)
}

fn robot_source(blueprint: Vec<[f32; 4]>) -> (Served, Feed) {
    let about = About {
        title: "/dev/ttyACM0".into(),
        subtitle: "NUCLEO-F429ZI, paper.toml".into(),
        kind: Kind::Robot,
        base_from_laser: [0.14, 0.0, 0.0],
        blueprint,
        paced: false,
    };
    let (source, feed) = channel(about);
    (Served::new(source), feed)
}

#[test]
fn buttons_reach_the_source_and_forget_asks_first() {
    let Some(browser) = Browser::open("live_browser, buttons", &DESK) else { return };
    let (served, heard) = obedient();
    browser.goto(&served.url());
    browser.until("lineslam.model.now.lines.size === 1");
    let next = || heard.recv_timeout(Duration::from_secs(30)).unwrap();
    for (button, command) in
        [("freeze", Command::Freeze), ("find_yourself", Command::FindYourself), ("ask_map", Command::AskMap)]
    {
        browser.click(&format!("[data-command={button}]"));
        assert_eq!(next(), command);
    }
    browser.until("[...document.querySelectorAll('.toast')].some((t) => t.textContent === 'It is done.')");

    browser.click("[data-command=forget]");
    browser.until("document.getElementById('confirm').open");
    browser.screenshot("forget");
    browser.click("#confirm [value=no]");
    assert_eq!(heard.try_recv().ok(), None, "nothing was told");
    browser.click("[data-command=forget]");
    browser.click("#confirm [value=yes]");
    assert_eq!(next(), Command::Forget);
    browser.click("[data-command=restart]");
    browser.click("#confirm [value=yes]");
    assert_eq!(next(), Command::Restart);

    // Where it is pressed and where it is dragged to.
    browser.click("[data-command=set_pose]");
    browser.until("lineslam.tools.tool === 'pose'");
    browser.drag([800, 400], [800, 300]);
    let expected: [f32; 2] =
        serde_json::from_value(browser.eval("return lineslam.camera.toMap(800, 400);")).unwrap();
    let Command::SetPose { pose: [x, y, theta] } = next() else { panic!("another command") };
    assert!((x - expected[0]).hypot(y - expected[1]) < 0.02, "{x} {y} {expected:?}");
    assert!((theta - std::f32::consts::FRAC_PI_2).abs() < 0.02, "{theta}");

    // Two clicks measure.
    browser.click("#measure");
    browser.drag([700, 300], [700, 300]);
    browser.drag([900, 300], [900, 300]);
    let measured = browser.until("lineslam.tools.measured.length === 2 && Math.abs(lineslam.tools.measured[1][0] - lineslam.tools.measured[0][0]) * lineslam.camera.scale");
    assert!((measured.as_f64().unwrap() - 200.0).abs() < 1.0, "{measured}");
    browser.screenshot("measured");
}

#[test]
fn another_site_can_neither_show_the_page_nor_command_the_robot() {
    let Some(browser) = Browser::open("live_browser, other sites", &DESK) else { return };
    let (served, heard) = obedient();
    let own = served.address;
    // Another site, with a page that tries.
    let site = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = site.local_addr().unwrap().port();
    let page = format!(
        r#"<!doctype html><title>other</title><iframe src="http://{own}/"></iframe><script>
        const s = new WebSocket("ws://{own}/ws");
        s.onopen = () => {{ s.send('{{"order":{{"id":1,"command":"forget"}}}}'); document.title = "open"; }};
        s.onerror = () => {{ document.title = "refused"; }};
        fetch("http://{own}/map.dxf").then(() => {{ window.read = "read"; }}, () => {{ window.read = "refused"; }});
        </script>"#
    );
    std::thread::spawn(move || {
        for stream in site.incoming() {
            let Ok(mut stream) = stream else { return };
            let _ = stream.read(&mut [0; 4096]);
            let head = format!(
                "HTTP/1.1 200 OK\r\nContent-Type: text/html\r\nContent-Length: {}\r\nConnection: close\r\n\r\n",
                page.len()
            );
            let _ = stream.write_all(format!("{head}{page}").as_bytes());
        }
    });
    for name in ["evil.example", "localhost"] {
        browser.goto(&format!("http://{name}:{port}/"));
        assert_eq!(browser.until("document.title !== 'other' && document.title"), json!("refused"), "{name}");
        assert_eq!(browser.until("window.read"), json!("refused"), "{name}");
    }
    // A name that was made to lead to this server.
    browser.goto(&format!("http://evil.example:{}/", own.port()));
    assert_eq!(browser.eval("return document.getElementById('map') === null;"), json!(true));
    assert_eq!(heard.try_recv().ok(), None, "nothing was told");

    // On the page itself nothing but its own modules runs.
    browser.goto(&served.url());
    browser.until("lineslam.link.connected");
    browser.eval(
        "window.violations = []; document.addEventListener('securitypolicyviolation', (e) => violations.push(e.effectiveDirective));
         const inline = document.createElement('script'); inline.textContent = 'window.ran = true;'; document.body.append(inline);
         const image = new Image(); image.src = 'http://evil.example/a.png'; document.body.append(image);",
    );
    browser.until("violations.length >= 2");
    assert_eq!(browser.eval("return window.ran ?? false;"), json!(false));
}

/// A large building: rows of rooms, and a path through all of them.
fn large(feed: &Feed) {
    let lines = (0..1024u32).map(|k| {
        let (x, y) = ((k % 32) as f32 * 4.0, (k / 32) as f32 * 2.5);
        let ends = if k.is_multiple_of(2) { [x, y, x + 3.2, y] } else { [x, y, x, y + 2.0] };
        Line { id: k, ends, hits: (k % 40) as u16 + 1, wall: !k.is_multiple_of(7) }
    });
    feed.send(1, What::Lines { changed: lines.collect(), removed: vec![] }).unwrap();
    let points = (0..19_900u64).map(|k| {
        let row = (k / 625) as f32;
        let along = (k % 625) as f32 * 0.2;
        let x = if (k / 625).is_multiple_of(2) { along } else { 124.8 - along };
        PathPoint { stamp_us: 2 + k, at: [x, row * 2.5 + 0.4 * (along * 2.0).sin()] }
    });
    feed.send(20_010, What::Path(points.collect())).unwrap();
}

fn driven(feed: &Feed, k: u64) -> bool {
    let (x, y) = (60.0 + 20.0 * (k as f32 * 0.003).cos(), 40.0 + 20.0 * (k as f32 * 0.003).sin());
    let pose = Pose {
        at: [x, y, k as f32 * 0.003],
        covariance: [0.01, 0.0, 0.0, 0.01, 0.0, 1e-3],
        state: TrackingState::Tracking,
    };
    let points_mm = (0..682).map(|b| {
        let bearing = f64::from(b - 341) * 0.006_136;
        [(4000.0 * bearing.cos()) as i32, (4000.0 * bearing.sin()) as i32]
    });
    let stamp_us = 100_000 + k * 1000;
    feed.send(stamp_us, What::Scan(Scan { at: pose.at, points_mm: points_mm.collect() })).is_ok()
        && feed.send(stamp_us, What::Pose(pose)).is_ok()
}

/// Bytes of the page's heap after a collection.
fn heap(browser: &Browser) -> u64 {
    browser.eval("globalThis.gc?.(); return performance.memory.usedJSHeapSize;").as_u64().unwrap()
}

#[test]
fn a_large_map_is_drawn_fast_and_memory_stays_flat() {
    let Some(browser) = Browser::open("live_browser, large map", &DESK) else { return };
    let (served, feed) = robot_source(Vec::new());
    browser.goto(&served.url());
    browser.until("lineslam.model.about");
    large(&feed);
    for k in 0..20 {
        driven(&feed, k);
    }
    browser.until("lineslam.model.now.lines.size === 1024 && lineslam.model.now.trail.length === 19920 && lineslam.model.now.scan");
    browser.screenshot("large");
    // Each frame moves the map, so each frame draws all of it.
    let timed = "
        const done = arguments[0];
        lineslam.measured = null;
        const { camera, counts } = lineslam;
        let frames = 0, drawMs = counts.drawMs, drawn = counts.frames, began = performance.now();
        const step = () => {
            camera.pan(Math.sin(frames / 9) * 6, Math.cos(frames / 9) * 6);
            lineslam.redraw();
            frames += 1;
            if (frames < 180) requestAnimationFrame(step);
            else lineslam.measured = {
                fps: 1000 * frames / (performance.now() - began),
                ms: (counts.drawMs - drawMs) / (counts.frames - drawn),
            };
        };
        requestAnimationFrame(step);";
    browser.eval(timed);
    let whole = browser.until("lineslam.measured");
    browser.eval("lineslam.camera.scale *= 8;");
    browser.eval(timed);
    let near = browser.until("lineslam.measured");
    let numbers = |of: &Value| [of["fps"].as_f64().unwrap(), of["ms"].as_f64().unwrap()];
    let ([fps, ms], [near_fps, near_ms]) = (numbers(&whole), numbers(&near));
    println!(
        "1024 lines, 20 000 points, drawn without a graphics processor: {fps:.0} frames/s, {ms:.2} ms each; near: {near_fps:.0} frames/s, {near_ms:.2} ms"
    );
    // At 60 a second there are 16.7 ms for one.
    assert!(ms < 8.0 && near_ms < 8.0, "{whole} {near}");

    // Hours of a drive at ten scans a second: as many poses as four hours have.
    let steady = 40_000;
    let sender = std::thread::spawn(move || {
        for k in 20..4 * steady {
            if !driven(&feed, k) {
                return;
            }
        }
        let _ = feed.send(u64::MAX / 2, What::Playback(Playback { speed: Some(1.0), ended: true }));
    });
    browser.until(&format!("lineslam.model.toUs >= {}", 100_000 + steady * 1000 - 2000));
    let before = heap(&browser);
    browser.until("lineslam.model.playback.ended");
    let after = heap(&browser);
    println!("heap of the page after 40 000 scans: {before} bytes, after 160 000: {after}");
    assert!(after < before * 3 / 2 + 8_000_000, "{before} → {after} bytes");
    let held = browser.eval("return [lineslam.model.now.trail.length, lineslam.model.states.length, lineslam.model.notes.length];");
    let held: [u64; 3] = serde_json::from_value(held).unwrap();
    assert!(held[0] <= 20_000 && held[1] <= 2001 && held[2] <= 400, "{held:?}");
    sender.join().unwrap();
}

#[test]
fn it_works_on_a_phone() {
    let phone = Window { width: 390, height: 844, dark: false, phone: true };
    let Some(browser) = Browser::open("live_browser, phone", &phone) else { return };
    let served = Served::new(simulated(None).start().unwrap());
    browser.goto(&served.url());
    browser.until("lineslam.model.playback.ended");
    is_drawn(&browser);
    browser.screenshot("phone-light");
    // Nothing is wider than the screen, and buttons are large enough for a finger.
    assert_eq!(browser.eval("return document.documentElement.scrollWidth <= innerWidth;"), json!(true));
    let small = browser.eval(
        "return [...document.querySelectorAll('button')].filter((b) => b.checkVisibility({ visibilityProperty: true })).map((b) => [b.id, b.getBoundingClientRect()])
            .filter(([, r]) => r.width > 0 && (r.width < 32 || r.height < 28 || r.right > innerWidth + 1 || r.left < -1)).map(([id]) => id);",
    );
    assert_eq!(small, json!([]));
    browser.click("#panel-open");
    browser.until("getComputedStyle(document.getElementById('panel')).transform === 'none' || new DOMMatrix(getComputedStyle(document.getElementById('panel')).transform).f < 1");
    browser.screenshot("phone-panel");
    browser.click("#panel-close");
    drop(browser);

    let dark = Window { dark: true, ..phone };
    let Some(browser) = Browser::open("live_browser, phone", &dark) else { return };
    browser.goto(&served.url());
    browser.until("lineslam.model.playback.ended");
    // What the system prefers, without a switch.
    assert_eq!(browser.eval("return matchMedia('(prefers-color-scheme: dark)').matches;"), json!(true));
    is_drawn(&browser);
    browser.screenshot("phone-dark");
}
