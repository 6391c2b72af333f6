//! The server: the page, the WebSocket, and drawings for CAD.

use std::net::{IpAddr, SocketAddr, TcpListener};
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::extract::ws::{Message as Packet, Utf8Bytes, WebSocket, WebSocketUpgrade};
use axum::extract::{Query, Request, State};
use axum::http::header::{CACHE_CONTROL, CONTENT_DISPOSITION, CONTENT_TYPE};
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use nalgebra::Isometry2;
use serde::Deserialize;
use slam_core::MapSegment;
use slam_core::geometry::pose::pose;
use slam_core::map::store::StoredLine;
use tokio::sync::broadcast;
use tokio::time::timeout;

use super::access::Access;
use super::history::{History, PATH_POINTS};
use super::hub::{self, Shared};
use super::messages::{self, Message, Scene};
use super::page::ASSETS;
use super::source::{Command, Note, Source, Weight};
use crate::output::dxf;

/// Port where none is given.
pub const PORT: u16 = 8017;
/// What a browser may do with the page: run its own modules, use its own style, talk to this server, and nothing else. `blob:` is
/// for pictures that the page saves.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; \
     base-uri 'none'; form-action 'none'; frame-ancestors 'none'";
/// Headers of every answer.
const HEADERS: [(&str, &str); 6] = [
    ("content-security-policy", POLICY),
    ("x-content-type-options", "nosniff"),
    ("referrer-policy", "no-referrer"),
    ("cross-origin-resource-policy", "same-origin"),
    ("cross-origin-opener-policy", "same-origin"),
    ("x-frame-options", "DENY"),
];
/// The longest message a page may send, bytes.
const LONGEST_REQUEST: usize = 4096;
/// A page that takes no message for so long is let go.
const PATIENCE: Duration = Duration::from_secs(20);
/// Pages that may be open at a time.
const MOST_PAGES: usize = 64;
/// Standard deviations that a wall is written with where the server does not know them.
const UNKNOWN_SIGMA: f32 = 0.01;

/// Where the server listens, and by which names it goes.
#[derive(Clone, Debug)]
pub struct Options {
    /// Address and port; port 0 takes a free one.
    pub listen: SocketAddr,
    /// Names besides addresses and `localhost`.
    pub names: Vec<String>,
}

impl Default for Options {
    fn default() -> Self {
        Self { listen: (IpAddr::from([127, 0, 0, 1]), PORT).into(), names: Vec::new() }
    }
}

/// The server could not begin.
#[derive(Debug, thiserror::Error)]
pub enum ServerError {
    /// Another program listens there.
    #[error(
        "{0} is in use, perhaps by another lineslam live: stop it, or choose another port with --listen (port 0 takes a free one)"
    )]
    InUse(SocketAddr),
    /// It cannot listen there.
    #[error("cannot listen on {0}")]
    Listen(SocketAddr, #[source] std::io::Error),
    /// It cannot serve.
    #[error("cannot serve")]
    Serve(#[source] std::io::Error),
}

/// A server that listens.
#[derive(Debug)]
pub struct Server {
    listener: TcpListener,
    address: SocketAddr,
    access: Access,
}

impl Server {
    /// Listens.
    pub fn bind(options: &Options) -> Result<Self, ServerError> {
        let failed = |error: std::io::Error| match error.kind() {
            std::io::ErrorKind::AddrInUse => ServerError::InUse(options.listen),
            _ => ServerError::Listen(options.listen, error),
        };
        let listener = TcpListener::bind(options.listen).map_err(failed)?;
        listener.set_nonblocking(true).map_err(failed)?;
        let address = listener.local_addr().map_err(failed)?;
        let access = Access { loopback: address.ip().is_loopback(), names: options.names.clone() };
        Ok(Self { listener, address, access })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Where a browser on this computer finds it.
    pub fn url(&self) -> String {
        let mut address = self.address;
        if address.ip().is_unspecified() {
            address.set_ip(if address.is_ipv4() {
                [127, 0, 0, 1].into()
            } else {
                IpAddr::from([0, 0, 0, 0, 0, 0, 0, 1])
            });
        }
        format!("http://{address}/")
    }

    /// Whether other computers can reach it.
    pub fn is_open(&self) -> bool {
        !self.access.loopback
    }

    /// Serves what a source tells until `stop` comes.
    pub fn run(self, source: Source, stop: impl Future<Output = ()>) -> Result<(), ServerError> {
        let runtime =
            tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(ServerError::Serve)?;
        let served = runtime.block_on(async {
            let listener = tokio::net::TcpListener::from_std(self.listener).map_err(ServerError::Serve)?;
            let shared = Arc::new(Shared::new(source.about, source.orders));
            tokio::select! {
                served = axum::serve(listener, router(Arc::clone(&shared), self.access)).into_future() => {
                    served.map_err(ServerError::Serve)
                }
                () = hub::run(source.events, shared) => Ok(()),
                () = stop => Ok(()),
            }
        });
        runtime.shutdown_background();
        served
    }
}

fn router(shared: Arc<Shared>, access: Access) -> Router {
    let mut router = Router::new();
    for asset in &ASSETS {
        router = router.route(asset.path, get(async || ([(CONTENT_TYPE, asset.content_type)], asset.text)));
    }
    let access = Arc::new(access);
    let socket_access = Arc::clone(&access);
    let socket =
        async move |State(shared): State<Arc<Shared>>, headers: HeaderMap, upgrade: WebSocketUpgrade| {
            match socket_access.check_origin(&headers) {
                Ok(()) if shared.pages() >= MOST_PAGES => {
                    (StatusCode::SERVICE_UNAVAILABLE, "too many pages are open\n").into_response()
                }
                Ok(()) => upgrade
                    .max_message_size(LONGEST_REQUEST)
                    .max_frame_size(LONGEST_REQUEST)
                    .on_upgrade(|socket| converse(socket, shared)),
                Err(refused) => (StatusCode::FORBIDDEN, format!("{refused}\n")).into_response(),
            }
        };
    router
        .route("/ws", get(socket))
        .route("/map.dxf", get(drawing))
        .layer(middleware::from_fn(move |request: Request, next: Next| {
            guarded(Arc::clone(&access), request, next)
        }))
        .with_state(shared)
}

/// Refuses hosts that are not ours, and sets the headers.
async fn guarded(access: Arc<Access>, request: Request, next: Next) -> Response {
    let mut response = match access.check_host(request.headers()) {
        Ok(()) => next.run(request).await,
        Err(refused) => (StatusCode::MISDIRECTED_REQUEST, format!("{refused}\n")).into_response(),
    };
    let headers = response.headers_mut();
    for (name, value) in HEADERS {
        headers.insert(HeaderName::from_static(name), HeaderValue::from_static(value));
    }
    headers.insert(CACHE_CONTROL, HeaderValue::from_static("no-store"));
    response
}

/// When the drawing is of.
#[derive(Deserialize)]
struct Instant {
    at_us: Option<u64>,
}

/// The map and the path as a drawing for CAD.
async fn drawing(State(shared): State<Arc<Shared>>, Query(Instant { at_us }): Query<Instant>) -> Response {
    let (map, path) = to_draw(&shared.history(), at_us.unwrap_or(u64::MAX));
    match dxf::render(&map, path.iter()) {
        Ok(bytes) => {
            // Without a name: the page gives it one.
            ([(CONTENT_TYPE, "image/vnd.dxf"), (CONTENT_DISPOSITION, "attachment")], bytes).into_response()
        }
        Err(error) => (StatusCode::INTERNAL_SERVER_ERROR, format!("{error}\n")).into_response(),
    }
}

fn to_draw(history: &History, at_us: u64) -> (Vec<MapSegment>, Vec<Isometry2<f32>>) {
    let map = history.map(at_us);
    let walls = map.lines.iter().filter(|line| line.wall).filter_map(|line| {
        let [ax, ay, bx, by] = line.ends;
        let stored = StoredLine {
            start_m: [ax, ay],
            end_m: [bx, by],
            middle_m: 0.0,
            sigma_offset_m: UNKNOWN_SIGMA,
            sigma_direction_rad: UNKNOWN_SIGMA,
            points: 0,
            hits: line.hits,
            seen_at_m: 0.0,
        };
        stored.entry()
    });
    let walls = walls.collect();
    (walls, history.path(at_us, PATH_POINTS).iter().map(|p| pose(p.at[0], p.at[1], 0.0)).collect())
}

/// One page, until it goes.
async fn converse(mut socket: WebSocket, shared: Arc<Shared>) {
    let hello = Message::Hello { version: messages::VERSION, about: shared.about.clone() };
    let (scene, mut news) = shared.joined();
    if !tell(&mut socket, hello.render().into()).await || !tell(&mut socket, scene.render().into()).await {
        return;
    }
    // An order waits for its source beside the news.
    let (answers_in, mut answers) = tokio::sync::mpsc::channel::<Message>(16);
    loop {
        let goes_on = tokio::select! {
            news_item = news.recv() => match news_item {
                Ok(text) => tell(&mut socket, text).await,
                Err(broadcast::error::RecvError::Lagged(_)) => {
                    let scene;
                    (scene, news) = shared.joined();
                    tell(&mut socket, scene.render().into()).await
                }
                Err(broadcast::error::RecvError::Closed) => false,
            },
            Some(answer) = answers.recv() => tell(&mut socket, answer.render().into()).await,
            packet = socket.recv() => match packet {
                Some(Ok(Packet::Text(text))) => match heard(&text, &shared, &answers_in) {
                    Some(answer) => tell(&mut socket, answer.render().into()).await,
                    None => true,
                },
                // Ping and pong are answered below.
                Some(Ok(Packet::Ping(_) | Packet::Pong(_))) => true,
                Some(Ok(Packet::Binary(_) | Packet::Close(_)) | Err(_)) | None => false,
            },
        };
        if !goes_on {
            return;
        }
    }
}

/// What a page asked. What can be answered at once is.
fn heard(text: &str, shared: &Arc<Shared>, answers: &tokio::sync::mpsc::Sender<Message>) -> Option<Message> {
    match serde_json::from_str(text) {
        Ok(messages::Request::View { id, at_us }) => Some(Scene::view(&shared.history(), id, at_us)),
        Ok(messages::Request::Order { id, command }) => {
            tokio::spawn(carry_out(id, command, Arc::clone(shared), answers.clone()));
            None
        }
        Err(error) => Some(Message::answer(0, Err(format!("this is no request: {error}")))),
    }
}

/// Gives an order to the source, notes what became of it, and answers.
async fn carry_out(
    id: u32,
    command: Command,
    shared: Arc<Shared>,
    answers: tokio::sync::mpsc::Sender<Message>,
) {
    let answer = shared.orders.give(command).await;
    if !matches!(command, Command::Pace { .. }) {
        let (weight, words) = match &answer {
            Ok(words) => (Weight::Info, words),
            Err(words) => (Weight::Warning, words),
        };
        shared.note(Note::new(weight, format!("{}: {words}", command.name())));
    }
    // The page may have gone; the order was carried out all the same.
    let _ = answers.send(Message::answer(id, answer)).await;
}

/// Sends a message. False where the page has gone, or takes nothing.
async fn tell(socket: &mut WebSocket, text: Utf8Bytes) -> bool {
    matches!(timeout(PATIENCE, socket.send(Packet::Text(text))).await, Ok(Ok(())))
}
