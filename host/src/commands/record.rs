//! `lineslam record`.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use anyhow::{Context, bail};
use indicatif::{HumanBytes, ProgressBar, ProgressStyle};
use lineslam::link::from_robot::Cause;
use lineslam::link::{Address, Client, Command, FromRobot, GREETING, LinkError, Streams, words};
use lineslam::recording::{RecordError, Recorder, STREAMS, Summary};

use super::common::terminal;

#[derive(clap::Args)]
pub struct Args {
    /// The MCAP file to write.
    out: PathBuf,
    /// Port of the robot: a device such as /dev/ttyACM0, or tcp://HOST:PORT of `cargo xtask emulate --vcp PORT`. By default that of the
    /// ST-LINK that is plugged in.
    #[arg(long, value_name = "PORT")]
    port: Option<Address>,
    /// Also write ticks and ranges as JSON lines, beside OUT under the same name with .jsonl.
    #[arg(long)]
    plain: bool,
    /// Overwrite OUT if it is there.
    #[arg(long)]
    force: bool,
    /// Have the robot forget its map first, so that the recording has all that the new one comes from, and replay does the same bit for
    /// bit. The old map cannot be had back.
    #[arg(long)]
    forget: bool,
    /// End after so many seconds.
    #[arg(long, value_name = "N")]
    seconds: Option<u64>,
}

/// It is asked again this often, so that one that was reset unheard is asked for its streams again.
const ASK: Duration = Duration::from_secs(2);
/// A port that is gone is tried again this often.
const RETRY: Duration = Duration::from_millis(500);
/// Messages are waited for no longer than this.
const LISTEN: Duration = Duration::from_millis(100);
/// Nothing was heard for so long: it is said.
const SILENCE: Duration = Duration::from_secs(3);

pub fn run(args: &Args) -> anyhow::Result<()> {
    let plain = args.plain.then(|| args.out.with_extension("jsonl"));
    if plain.as_ref() == Some(&args.out) {
        bail!("{}: --plain writes there; give the MCAP file another name", args.out.display());
    }
    // Said before a robot is waited for; making the file says it again.
    if let Some(path) =
        [Some(&args.out), plain.as_ref()].into_iter().flatten().find(|path| path.exists() && !args.force)
    {
        return Err(RecordError::Exists { path: path.clone() }.into());
    }
    let address = args.port.clone().map_or_else(Address::find, Ok)?;
    let stop = Stop::watch(args.seconds)?;
    let mut client = Client::connect(&address)?;
    // Nothing is written before there is a robot.
    let mut heard = greet(&mut client)?;
    if args.forget {
        heard.retain(|message| matches!(message, FromRobot::Hello(_)));
        heard.push(forget(&mut client)?);
    }
    let recorder = Recorder::create(&args.out, plain.as_deref(), args.force)?;
    let mut recording = Recording { args, recorder, clock: Clock::new(), shown: Shown::new() };
    eprintln!("recording {address} to {}; Ctrl-C ends it", args.out.display());
    let ended = recording.run(client, heard, &stop);
    // What has come is kept, whatever it ended by.
    let Recording { recorder, shown, .. } = recording;
    let summary = recorder.finish()?;
    shown.bar.finish_and_clear();
    ended?;
    let bytes = std::fs::metadata(&args.out).with_context(|| args.out.display().to_string())?.len();
    println!("{}", in_words(&summary, bytes));
    Ok(())
}

/// Asks until the robot answers. What it said meanwhile.
fn greet(client: &mut Client) -> Result<Vec<FromRobot>, LinkError> {
    let (hello, mut heard) = client.greet(STREAMS, GREETING)?;
    heard.push(FromRobot::Hello(hello));
    Ok(heard)
}

/// Has the robot begin a new map. The pose from which on it has one: what it said before is of no use.
fn forget(client: &mut Client) -> anyhow::Result<FromRobot> {
    if let Some(why) = words::of_refusal(client.request(Command::Forget)?) {
        bail!("{}: --forget: {why}", client.address());
    }
    let asked = Instant::now();
    while asked.elapsed() < GREETING {
        match client.next(LISTEN)? {
            Some(FromRobot::Pose(pose)) if pose.cause == Cause::Forgotten => {
                return Ok(FromRobot::Pose(pose));
            }
            _ => {}
        }
    }
    Err(LinkError::NoAnswer { address: client.address().clone(), waited: GREETING }.into())
}

/// When it is to end.
struct Stop {
    interrupted: Arc<AtomicBool>,
    at: Option<Instant>,
}

impl Stop {
    /// Ctrl-C, the system's wish, or so many seconds.
    fn watch(seconds: Option<u64>) -> anyhow::Result<Self> {
        let interrupted = Arc::new(AtomicBool::new(false));
        let runtime = tokio::runtime::Builder::new_current_thread().enable_io().build();
        let runtime = runtime.context("cannot wait for Ctrl-C")?;
        let (flag, (ready, is_ready)) = (interrupted.clone(), std::sync::mpsc::channel());
        std::thread::spawn(move || {
            runtime.block_on(async {
                let wish = wish_to_end(&ready);
                // Without it the system ends the program by itself, and the file is good all the same.
                if wish.await.is_ok() {
                    flag.store(true, Ordering::Relaxed);
                }
            });
        });
        // From here on no signal ends the program.
        is_ready.recv().context("cannot wait for Ctrl-C")?;
        Ok(Self { interrupted, at: seconds.map(|seconds| Instant::now() + Duration::from_secs(seconds)) })
    }

    fn is_due(&self) -> bool {
        self.interrupted.load(Ordering::Relaxed) || self.at.is_some_and(|at| Instant::now() >= at)
    }
}

#[cfg(unix)]
async fn wish_to_end(ready: &std::sync::mpsc::Sender<()>) -> std::io::Result<()> {
    use tokio::signal::unix::{SignalKind, signal};
    let (mut interrupt, mut terminate) = (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?);
    // Whoever waits for it has not gone.
    let _ = ready.send(());
    tokio::select! {
        _ = interrupt.recv() => {}
        _ = terminate.recv() => {}
    }
    Ok(())
}

#[cfg(not(unix))]
async fn wish_to_end(ready: &std::sync::mpsc::Sender<()>) -> std::io::Result<()> {
    let _ = ready.send(());
    tokio::signal::ctrl_c().await
}

/// Microseconds since 1970 that go on evenly, though somebody sets the clock.
struct Clock {
    begun: Instant,
    begun_us: u64,
}

impl Clock {
    fn new() -> Self {
        let since_1970 = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        Self { begun: Instant::now(), begun_us: since_1970.as_micros() as u64 }
    }

    fn now_us(&self) -> u64 {
        self.begun_us + self.begun.elapsed().as_micros() as u64
    }
}

struct Recording<'a> {
    args: &'a Args,
    recorder: Recorder,
    clock: Clock,
    shown: Shown,
}

impl Recording<'_> {
    /// Records until it is to end, through resets and pulled cables.
    fn run(&mut self, client: Client, heard: Vec<FromRobot>, stop: &Stop) -> anyhow::Result<()> {
        let address = client.address().clone();
        let mut client = Some(client);
        for message in &heard {
            self.recorder.take(message, self.clock.now_us())?;
        }
        while !stop.is_due() {
            let Some(open) = &mut client else {
                std::thread::sleep(RETRY);
                client = self.reopen(&address)?;
                continue;
            };
            if let Err(error) = self.listen(open, stop)? {
                let text = format!("{:#}: waiting for it to come back", anyhow::Error::from(error));
                self.shown.bar.suspend(|| eprintln!("{text}"));
                self.recorder.port(self.clock.now_us(), &text)?;
                client = None;
            }
        }
        if let Some(mut client) = client {
            // The robot need not say all that any more. That it has heard so is of no importance.
            let _ = client.send(Command::Subscribe(Streams::DEFAULT));
        }
        Ok(())
    }

    fn reopen(&mut self, address: &Address) -> anyhow::Result<Option<Client>> {
        let Ok(mut client) = Client::connect(address) else { return Ok(None) };
        let Ok(heard) = greet(&mut client) else { return Ok(None) };
        let text = format!("{address}: connected again");
        self.shown.bar.suspend(|| eprintln!("{text}"));
        self.recorder.port(self.clock.now_us(), &text)?;
        for message in &heard {
            self.recorder.take(message, self.clock.now_us())?;
        }
        Ok(Some(client))
    }

    /// Records until it is to end, or until the port is gone, which is the inner error.
    fn listen(&mut self, client: &mut Client, stop: &Stop) -> anyhow::Result<Result<(), LinkError>> {
        let (mut heard, mut asked, mut is_silent) = (Instant::now(), Instant::now(), false);
        while !stop.is_due() {
            if asked.elapsed() > ASK {
                asked = Instant::now();
                if let Err(error) = client.send(Command::Hello) {
                    return Ok(Err(error));
                }
            }
            match client.next(LISTEN) {
                Err(error) => return Ok(Err(error)),
                Ok(Some(message)) => {
                    (heard, is_silent) = (Instant::now(), false);
                    if let Some(command) = self.recorder.take(&message, self.clock.now_us())?
                        && let Err(error) = client.send(command)
                    {
                        return Ok(Err(error));
                    }
                }
                Ok(None) if heard.elapsed() > SILENCE && !is_silent => {
                    is_silent = true;
                    let text = format!("nothing has been heard for {} s", SILENCE.as_secs());
                    self.shown.bar.suspend(|| eprintln!("{text}"));
                    self.recorder.port(self.clock.now_us(), &text)?;
                }
                Ok(None) => {}
            }
            self.shown.show(&self.recorder.summary(), &self.args.out);
        }
        Ok(Ok(()))
    }
}

/// The line that shows how it goes, on a terminal.
struct Shown {
    bar: ProgressBar,
    /// Bytes of the file when they were looked at last.
    before: (Instant, u64),
    rate: f64,
}

impl Shown {
    fn new() -> Self {
        let style = ProgressStyle::with_template("{spinner} {msg}").expect("the template is a constant");
        let bar = ProgressBar::with_draw_target(None, terminal()).with_style(style);
        Self { bar, before: (Instant::now(), 0), rate: 0.0 }
    }

    fn show(&mut self, summary: &Summary, out: &std::path::Path) {
        let (at, before) = self.before;
        if at.elapsed() < Duration::from_secs(1) {
            return;
        }
        let bytes = std::fs::metadata(out).map_or(before, |file| file.len());
        self.rate = bytes.saturating_sub(before) as f64 / at.elapsed().as_secs_f64();
        self.before = (Instant::now(), bytes);
        self.bar.set_message(format!("{}; {:.0} kB/s", in_words(summary, bytes), self.rate * 1e-3));
        self.bar.tick();
    }
}

/// What was recorded, in a line.
fn in_words(summary: &Summary, bytes: u64) -> String {
    let Summary { scans, samples, runs, missing, joined, span_us, .. } = *summary;
    let resets = match runs.saturating_sub(1) {
        0 => String::new(),
        1 => ", 1 reset".into(),
        resets => format!(", {resets} resets"),
    };
    let missing = match (missing.is_none(), joined) {
        (true, false) => "nothing missing".into(),
        (true, true) => "nothing missing since it began, in the middle of a drive".into(),
        (false, _) => format!("{} missing: replay will not be bit for bit", missing.words()),
    };
    let seconds = span_us as f64 * 1e-6;
    format!(
        "{seconds:.1} s, {scans} scans, {samples} samples of the wheels{resets}, {}; {missing}",
        HumanBytes(bytes)
    )
}
