//! The page of `lineslam live` beside a run, served by this process.

use std::net::SocketAddr;
use std::thread::JoinHandle;

use anyhow::Context;
use emulator::vcp::Socket;
use lineslam::link::Address;
use lineslam::live::browser;
use lineslam::live::robot_source::{self, Emulated};
use lineslam::live::server::{Options, Server, ServerError};
use lineslam::sim::judge;
use lineslam::sim::world::World;

/// A page that is served until this process ends.
pub struct Page {
    url: String,
    /// Somebody may look at it.
    opened: bool,
    server: JoinHandle<()>,
}

impl Page {
    /// Begins to serve the run whose virtual COM port is that socket, and says where.
    pub fn show(vcp: &Socket, world: &World, seed: u64, open: bool) -> anyhow::Result<Self> {
        let server = listen()?;
        let address = Address::Tcp(vcp.address()?.to_string());
        let emulated = Emulated {
            title: format!("{}, seed {seed}, emulated", world.name),
            blueprint: judge::blueprint_from(world, &world.path.start()),
        };
        let url = server.url();
        println!("{url} shows the drive");
        let server = std::thread::Builder::new().name("page".into()).spawn(move || {
            if let Err(error) = serve(server, address, emulated) {
                eprintln!("warning: the page is not served: {error:#}");
            }
        });
        let server = server.context("the page's thread")?;
        let opened = open
            && match browser::show(&url) {
                Ok(()) => true,
                Err(error) => {
                    eprintln!("no browser was opened ({error})");
                    false
                }
            };
        Ok(Self { url, opened, server })
    }

    /// Keeps a page that was opened, until it is interrupted.
    pub fn stay(self) {
        if self.opened {
            println!("\n{} stays until Ctrl-C.", self.url);
            // It has said why it ended.
            let _ = self.server.join();
        }
    }
}

/// At the usual port, or another where that is taken: a run is not to fail because a page is open elsewhere.
fn listen() -> Result<Server, ServerError> {
    match Server::bind(&Options::default()) {
        Err(ServerError::InUse(_)) => {
            Server::bind(&Options { listen: SocketAddr::from(([127, 0, 0, 1], 0)), names: Vec::new() })
        }
        other => other,
    }
}

fn serve(server: Server, address: Address, emulated: Emulated) -> anyhow::Result<()> {
    let source = robot_source::start_emulated(address, emulated)?;
    Ok(server.run(source, std::future::pending())?)
}
