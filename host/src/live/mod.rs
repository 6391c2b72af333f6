//! See it live: a server on this computer, and a page that shows map, path, scan and health as they come.
//!
//! ```text
//!  source ──► Event ──► hub ──► History ──► scene, view ──► page
//!  log, robot   ▲         └────────────────► frame ───────►   │
//!     ▲         └ stamped                                     │
//!     └──────────────── Order ◄── server (own origin only) ◄──┘
//! ```
//!
//! A [`source`] runs on a thread of its own and knows nothing of the page; the server knows nothing of where its events come
//! from. [`log_source`] replays a log, or a simulated drive, through the core and obeys what makes sense for one; [`robot_source`] shows a robot
//! at the other end of a cable, or the emulated one at a socket.
//!
//! [`screen`] shows the same as text on a terminal, [`foxglove`] to Foxglove beside the page.
//!
//! The server holds the drive so far, in bounded memory ([`history`]), so that whoever comes late sees all of it and the page
//! can look at any instant. The page is plain modules in `page/`, without a build step and without anything from elsewhere.

pub mod access;
pub mod browser;
pub mod foxglove;
pub mod history;
mod hub;
pub mod log_source;
pub mod messages;
mod page;
pub mod robot_source;
pub mod screen;
pub mod server;
pub mod source;
pub mod status;
mod trail;
