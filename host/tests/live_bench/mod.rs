//! A server in this process, as both kinds of tests of `lineslam live` want it.

#![allow(dead_code)]

use std::net::SocketAddr;
use std::path::Path;
use std::sync::OnceLock;
use std::thread::JoinHandle;

use lineslam::configuration::Configuration;
use lineslam::live::log_source::LogSource;
use lineslam::live::server::{Options, Server};
use lineslam::live::source::Source;
use lineslam::replay::Start;
use lineslam::robot::Robot;
use lineslam::sim::world::World;
use lineslam::sim::{self, Drive, SimConfig, judge};
use tokio::sync::oneshot;

/// A server that runs until it is dropped.
pub struct Served {
    pub address: SocketAddr,
    stop: Option<oneshot::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl Served {
    /// Serves on a free port.
    pub fn new(source: Source) -> Self {
        Self::at("127.0.0.1:0".parse().unwrap(), source)
    }

    pub fn at(listen: SocketAddr, source: Source) -> Self {
        let server = Server::bind(&Options { listen, names: Vec::new() }).unwrap();
        let address = server.address();
        let (stop, stopped) = oneshot::channel::<()>();
        let thread = std::thread::spawn(move || {
            server
                .run(source, async {
                    let _ = stopped.await;
                })
                .unwrap();
        });
        Self { address, stop: Some(stop), thread: Some(thread) }
    }

    pub fn url(&self) -> String {
        format!("http://{}/", self.address)
    }
}

impl Drop for Served {
    fn drop(&mut self) {
        drop(self.stop.take());
        if let Some(Err(panic)) = self.thread.take().map(JoinHandle::join)
            && !std::thread::panicking()
        {
            std::panic::resume_unwind(panic);
        }
    }
}

/// A simulated drive, driven once for all tests.
pub fn drive() -> &'static (World, Drive) {
    static DRIVE: OnceLock<(World, Drive)> = OnceLock::new();
    DRIVE.get_or_init(|| {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../worlds/hall_quarter.toml");
        let world = World::load(&path).unwrap();
        let drive = sim::drive(&world, &robot(), &SimConfig::default(), 1).unwrap();
        (world, drive)
    })
}

pub fn robot() -> Robot {
    Robot::usual_for("simulated")
}

/// That drive as a source.
pub fn simulated(speed: Option<f32>) -> LogSource {
    let (world, drive) = drive();
    LogSource {
        log: drive.log.clone(),
        robot: robot(),
        configuration: Configuration::Default,
        start: Start::default(),
        speed,
        title: format!("{}, seed 1", world.name),
        blueprint: Some(judge::blueprint_in_map(world, drive)),
    }
}
