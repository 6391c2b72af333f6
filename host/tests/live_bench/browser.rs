//! A real browser: Chromium, driven over WebDriver.

#![allow(dead_code)] // Each test file uses its part.

use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use fantoccini::{Client, ClientBuilder};
use hyper_util::client::legacy::connect::HttpConnector;
use serde_json::{Value, json};
use tempfile::TempDir;
use tokio::runtime::Runtime;

const PATIENCE: Duration = Duration::from_secs(90);

/// One browser at a time: two of them on two cores would starve each other.
static TURN: Mutex<()> = Mutex::new(());

/// What the window is like.
pub struct Window {
    pub width: u32,
    pub height: u32,
    /// Prefers dark.
    pub dark: bool,
    /// A phone: touch, and two pixels for one.
    pub phone: bool,
}

pub const DESK: Window = Window { width: 1440, height: 900, dark: false, phone: false };

pub struct Browser {
    runtime: Runtime,
    client: Option<Client>,
    driver: Child,
    pub downloads: TempDir,
    _turn: MutexGuard<'static, ()>,
}

/// A program of one of these names, as an environment variable or the path has it.
fn program(variable: &str, names: &[&str]) -> Option<PathBuf> {
    let given = std::env::var_os(variable).map(PathBuf::from);
    given.into_iter().chain(names.iter().map(PathBuf::from)).find(|name| {
        let asked = Command::new(name).arg("--version").stdout(Stdio::null()).stderr(Stdio::null()).status();
        asked.is_ok_and(|status| status.success())
    })
}

impl Browser {
    /// Opens one. `None` where there is none, which is said.
    pub fn open(test: &str, window: &Window) -> Option<Self> {
        let turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
        let driver = program("LINESLAM_CHROMEDRIVER", &["chromedriver"]);
        let chromium = program("LINESLAM_CHROMIUM", &["chromium", "chromium-browser", "google-chrome"]);
        let (Some(driver), Some(chromium)) = (driver, chromium) else {
            // Not by println: the test runner keeps that to itself.
            let _ = writeln!(
                std::io::stdout(),
                "\nSKIPPED {test}: chromium and chromedriver are not both installed (Debian: apt-get install chromium chromium-driver)"
            );
            return None;
        };
        let mut driver = Command::new(driver)
            .arg("--port=0")
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let port = port_of(&mut driver);
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let downloads = tempfile::tempdir().unwrap();
        let capabilities = capabilities(window, &chromium, downloads.path());
        let client = runtime.block_on(async {
            ClientBuilder::new(HttpConnector::new())
                .capabilities(capabilities.as_object().cloned().unwrap())
                .connect(&format!("http://127.0.0.1:{port}"))
                .await
                .unwrap()
        });
        Some(Self { runtime, client: Some(client), driver, downloads, _turn: turn })
    }

    fn client(&self) -> &Client {
        self.client.as_ref().unwrap()
    }

    pub fn goto(&self, url: &str) {
        self.runtime.block_on(self.client().goto(url)).unwrap();
    }

    /// What a script returns.
    pub fn eval(&self, script: &str) -> Value {
        self.runtime
            .block_on(self.client().execute(script, Vec::new()))
            .unwrap_or_else(|e| panic!("{script}: {e}"))
    }

    /// Waits until an expression is true; returns what it is.
    pub fn until(&self, expression: &str) -> Value {
        let started = Instant::now();
        loop {
            let value = self.eval(&format!("return ({expression});"));
            if !matches!(value, Value::Null | Value::Bool(false)) && value != json!(0) && value != json!("") {
                return value;
            }
            if started.elapsed() > PATIENCE {
                self.screenshot("gave-up");
                panic!("it never came to this: {expression}");
            }
            std::thread::sleep(Duration::from_millis(40));
        }
    }

    /// Clicks what a selector finds, as a person would.
    pub fn click(&self, selector: &str) {
        self.runtime.block_on(async {
            let found = self.client().find(fantoccini::Locator::Css(selector)).await;
            found
                .unwrap_or_else(|e| panic!("{selector}: {e}"))
                .click()
                .await
                .unwrap_or_else(|e| panic!("{selector}: {e}"));
        });
    }

    /// Presses the mouse on the map, moves, and lets go; in pixels of the page.
    pub fn drag(&self, from: [i64; 2], to: [i64; 2]) {
        use fantoccini::actions::{InputSource, MOUSE_BUTTON_LEFT, MouseActions, PointerAction};
        let moved = |[x, y]: [i64; 2]| PointerAction::MoveTo { duration: None, x: x as f64, y: y as f64 };
        let actions = MouseActions::new("mouse".into())
            .then(moved(from))
            .then(PointerAction::Down { button: MOUSE_BUTTON_LEFT })
            .then(moved(to))
            .then(PointerAction::Up { button: MOUSE_BUTTON_LEFT });
        self.runtime.block_on(self.client().perform_actions(actions)).unwrap();
    }

    /// Keeps a picture for people, and returns its size, bytes.
    pub fn screenshot(&self, name: &str) -> usize {
        let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("live");
        std::fs::create_dir_all(&folder).unwrap();
        let picture = self.runtime.block_on(self.client().screenshot()).unwrap();
        std::fs::write(folder.join(format!("{name}.png")), &picture).unwrap();
        picture.len()
    }

    /// The file that a download ends as.
    pub fn downloaded(&self, name: &str) -> Vec<u8> {
        let path = self.downloads.path().join(name);
        let started = Instant::now();
        while !path.exists() {
            assert!(started.elapsed() < PATIENCE, "{} never came", path.display());
            std::thread::sleep(Duration::from_millis(40));
        }
        std::fs::read(path).unwrap()
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        if let Some(client) = self.client.take() {
            let _ = self.runtime.block_on(client.close());
        }
        let _ = self.driver.kill();
        let _ = self.driver.wait();
    }
}

fn port_of(driver: &mut Child) -> u16 {
    let lines = BufReader::new(driver.stdout.take().unwrap()).lines();
    let said = lines.map_while(Result::ok).find(|line| line.contains("successfully on port")).unwrap();
    let digits: String =
        said.chars().rev().skip_while(|c| !c.is_ascii_digit()).take_while(char::is_ascii_digit).collect();
    digits.chars().rev().collect::<String>().parse().unwrap()
}

fn capabilities(window: &Window, chromium: &Path, downloads: &Path) -> Value {
    let Window { width, height, dark, phone } = window;
    // Chromium takes 0 for dark and 1 for light.
    let scheme = u8::from(!dark);
    let mut options = json!({
        "args": [
            "--headless=new",
            // In a container there are neither user namespaces nor much shared memory.
            "--no-sandbox",
            "--disable-dev-shm-usage",
            "--hide-scrollbars",
            "--no-first-run",
            // Memory is measured after a collection, and to the byte.
            "--js-flags=--expose-gc",
            "--enable-precise-memory-info",
            "--host-resolver-rules=MAP evil.example 127.0.0.1",
            format!("--blink-settings=preferredColorScheme={scheme}"),
            format!("--window-size={width},{height}"),
        ],
        "prefs": { "download.default_directory": downloads, "download.prompt_for_download": false },
    });
    if chromium.is_absolute() {
        options["binary"] = json!(chromium);
    }
    if *phone {
        options["mobileEmulation"] =
            json!({ "deviceMetrics": { "width": width, "height": height, "pixelRatio": 2, "touch": true } });
    }
    json!({ "browserName": "chrome", "goog:chromeOptions": options })
}
