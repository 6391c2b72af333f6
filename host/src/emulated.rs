//! The emulated board, a program of its own: started, found, and ended with whoever started it.
//!
//! ```text
//! [Drive] ──► cargo xtask emulate ──► "the virtual COM port is tcp://…" ──► [Board::address]
//!                     ▲           └─► "the drive is over"              ──► [Driven::is_over]
//!                     └── standard input: the board ends when it is closed, whatever becomes of whoever holds the other end
//! ```
//!
//! The emulator is built with a newer compiler than the rest needs, so it is no part of this one. Its errors go to where ours go.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, ExitStatus, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use crate::link::Address;

/// Before the address of the emulated board's port.
pub const PORT_IS: &str = "the virtual COM port is ";
/// At the end of the path.
pub const IS_OVER: &str = "the drive is over";
/// Worlds lie here in the source tree.
const WORLDS: &str = "worlds";
/// A board whose input was closed has ended by then.
const ENDS_WITHIN: Duration = Duration::from_secs(3);
/// It is looked at again after this.
const AGAIN: Duration = Duration::from_millis(20);

/// Why there is no emulated board.
#[derive(Debug, thiserror::Error)]
pub enum EmulationError {
    /// What the emulator is built from is not there.
    #[error("the emulated board is built from the source tree, which is neither here nor at {}: run this in a clone of it", built_in.display())]
    NoTree {
        /// Where this program was built.
        built_in: PathBuf,
    },
    /// Neither a file nor one of the worlds.
    #[error("{given} is no world file, and none of the worlds {}", worlds.join(", "))]
    UnknownWorld {
        /// As given.
        given: String,
        /// Names of those there are.
        worlds: Vec<String>,
    },
    /// The program that builds and runs it cannot be started.
    #[error("{} cannot be run, which builds and runs the emulated board; https://rustup.rs has it", program.display())]
    NotStarted {
        /// Which.
        program: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// It has ended.
    #[error("the emulated board has ended ({status}); what is above says why")]
    Ended {
        /// How.
        status: ExitStatus,
    },
    /// It cannot be watched.
    #[error("the emulated board cannot be watched")]
    Watch(#[source] std::io::Error),
}

/// Where the emulated robot drives, and how.
#[derive(Clone, Debug)]
pub struct Drive {
    tree: PathBuf,
    /// File of the world.
    pub world: PathBuf,
    /// Of all noise.
    pub seed: u64,
    /// Times as fast as a real one; none is as fast as it goes.
    pub speed: Option<f32>,
    /// Errors of the robot that are changed, `KEY=VALUE`.
    pub settings: Vec<String>,
}

impl Drive {
    /// In a world: a file, or a name in the source tree's `worlds/`.
    pub fn new(world: &str, seed: u64, speed: Option<f32>) -> Result<Self, EmulationError> {
        let tree = source_tree()?;
        let given = Path::new(world);
        let of_name = tree.join(WORLDS).join(format!("{world}.toml"));
        let file = [given, &of_name].into_iter().find(|file| file.is_file());
        let world = file.and_then(|file| std::path::absolute(file).ok()).ok_or_else(|| {
            EmulationError::UnknownWorld { given: world.to_owned(), worlds: names_in(&tree.join(WORLDS)) }
        })?;
        Ok(Self { tree, world, seed, speed, settings: Vec::new() })
    }

    /// Builds firmware and emulator where they are not built, and starts the board.
    pub fn start(&self) -> Result<Board, EmulationError> {
        let mut command = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
        command.current_dir(&self.tree).args(["xtask", "emulate", "--attended", "--vcp", "0"]);
        command.arg("--world").arg(&self.world).arg("--seed").arg(self.seed.to_string());
        command.arg("--speed").arg(self.speed.map_or_else(|| "max".to_owned(), |speed| speed.to_string()));
        for setting in &self.settings {
            command.arg("--set").arg(setting);
        }
        Board::start(&mut command)
    }
}

/// The clone of the repository that is here, or else the one in which this was built.
fn source_tree() -> Result<PathBuf, EmulationError> {
    let is_tree =
        |folder: &&Path| folder.join("emulator/Cargo.toml").is_file() && folder.join("xtask").is_dir();
    let here = std::env::current_dir().unwrap_or_default();
    let built_in = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap_or(Path::new(""));
    let found = here.ancestors().chain([built_in]).find(is_tree);
    found.map(Path::to_owned).ok_or_else(|| EmulationError::NoTree { built_in: built_in.to_owned() })
}

fn names_in(folder: &Path) -> Vec<String> {
    let files = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
    let name = |file: PathBuf| {
        let is_world = file.extension().is_some_and(|extension| extension == "toml");
        is_world.then(|| file.file_stem().map(|stem| stem.to_string_lossy().into_owned())).flatten()
    };
    let mut names: Vec<String> = files.filter_map(name).collect();
    names.sort();
    names
}

/// An emulated board that runs. It ends when this is dropped, or its owner ends.
#[derive(Debug)]
pub struct Board {
    child: Child,
    /// Open as long as the board is to run.
    input: Option<ChildStdin>,
    address: Address,
    drive: Driven,
}

/// Whether the path is driven.
#[derive(Clone, Debug, Default)]
pub struct Driven(Arc<AtomicBool>);

impl Driven {
    /// It is. The robot stands at its end.
    pub fn is_over(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

impl Board {
    /// Starts an emulator that is told `--attended` and `--vcp 0`, and waits until it says where its port is. All else that it says
    /// goes to standard error.
    pub fn start(command: &mut Command) -> Result<Self, EmulationError> {
        let mut child =
            command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().map_err(|source| {
                EmulationError::NotStarted { program: command.get_program().into(), source }
            })?;
        let input = child.stdin.take();
        let mut said = child.stdout.take().map(BufReader::new);
        let Some(address) = said.as_mut().and_then(port_said) else {
            drop(input);
            return Err(EmulationError::Ended { status: child.wait().map_err(EmulationError::Watch)? });
        };
        let drive = Driven::default();
        let driven = drive.clone();
        std::thread::spawn(move || {
            for line in said.into_iter().flat_map(BufRead::lines).map_while(Result::ok) {
                if line == IS_OVER {
                    driven.0.store(true, Ordering::Relaxed);
                } else {
                    eprintln!("{line}");
                }
            }
        });
        Ok(Self { child, input, address, drive })
    }

    /// Where its virtual COM port is.
    pub fn address(&self) -> &Address {
        &self.address
    }

    /// How far it is with its path.
    pub fn drive(&self) -> Driven {
        self.drive.clone()
    }

    /// An error once it has ended by itself.
    pub fn check(&mut self) -> Result<(), EmulationError> {
        match self.child.try_wait().map_err(EmulationError::Watch)? {
            Some(status) => Err(EmulationError::Ended { status }),
            None => Ok(()),
        }
    }

    /// Waits until the path is driven.
    pub fn wait(&mut self) -> Result<(), EmulationError> {
        while !self.drive.is_over() {
            self.check()?;
            std::thread::sleep(AGAIN);
        }
        Ok(())
    }
}

/// The address of the port, once it is said. None where the output ends before.
fn port_said(said: &mut BufReader<ChildStdout>) -> Option<Address> {
    for line in said.lines().map_while(Result::ok) {
        match line.strip_prefix(PORT_IS).and_then(|address| address.parse().ok()) {
            Some(address) => return Some(address),
            None => eprintln!("{line}"),
        }
    }
    None
}

impl Drop for Board {
    fn drop(&mut self) {
        self.input = None;
        let closed = Instant::now();
        while closed.elapsed() < ENDS_WITHIN {
            if !matches!(self.child.try_wait(), Ok(None)) {
                return;
            }
            std::thread::sleep(AGAIN);
        }
        // It hangs. Where that fails it is gone.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
