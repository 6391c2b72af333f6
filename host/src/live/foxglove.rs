//! What the page shows, for Foxglove: map, path, scan and pose over its WebSocket protocol.
//!
//! ```text
//! source ──► Event ──► [tee] ──► hub, page
//!                        └─────► /map, /path, /scan, /pose, /tf ──► Foxglove
//! ```
//!
//! Lines of the map and the path are a scene, which is sent whole: whoever comes late sees all of it with the next status, a second later. A
//! scan is a cloud of points, since its beams without an obstacle are not told here.

use std::collections::BTreeMap;
use std::sync::Arc;

use foxglove::messages::line_primitive::Type;
use foxglove::messages::packed_element_field::NumericType;
use foxglove::messages::{
    Color, FrameTransform, LinePrimitive, PackedElementField, Point3, PointCloud, Pose, PoseInFrame,
    Quaternion, SceneEntity, SceneUpdate, Timestamp, Vector3,
};
use foxglove::{Channel, ChannelBuilder, Context, FoxgloveError, WebSocketServer, WebSocketServerHandle};

use super::source::{Closed, Event, Line, Pose as RobotPose, Scan, Source, What, channel};
use super::trail::Trail;
use crate::output::mcap::{BASE, MAP};

/// Width of what is drawn, pixels.
const WALL_PX: f64 = 3.0;
const THIN_PX: f64 = 1.0;
const WALL: Color = Color { r: 0.05, g: 0.2, b: 0.45, a: 1.0 };
const TENTATIVE: Color = Color { r: 0.4, g: 0.5, b: 0.65, a: 0.6 };
const PATH: Color = Color { r: 0.8, g: 0.15, b: 0.1, a: 1.0 };
const TRUTH: Color = Color { r: 0.55, g: 0.8, b: 0.55, a: 0.8 };
/// A coordinate of a point is so many bytes.
const FLOAT: u32 = 4;

/// Serves a source on this port of 127.0.0.1 (zero: any), and hands on all that it tells. The server ends with the handle.
pub fn tee(mut source: Source, port: u16) -> Result<(Source, WebSocketServerHandle), FoxgloveError> {
    let context = Context::new();
    let server =
        WebSocketServer::new().name("lineslam").context(&context).bind("127.0.0.1", port).start_blocking()?;
    let (mut outer, feed) = channel(source.about.clone());
    // Orders go past this.
    outer.orders = source.orders.clone();
    let mut shown = Shown::new(&context, &source.about.blueprint);
    std::thread::spawn(move || {
        while let Some(event) = source.events.blocking_recv() {
            shown.take(&event);
            if let Err(Closed) = feed.send(event.stamp_us, event.what) {
                return;
            }
        }
    });
    Ok((outer, server))
}

/// What is told, and what is held of it to tell it again.
struct Shown {
    /// Channels and the server know it weakly.
    _context: Arc<Context>,
    map: Channel<SceneUpdate>,
    path: Channel<SceneUpdate>,
    scan: Channel<PointCloud>,
    pose: Channel<PoseInFrame>,
    transform: Channel<FrameTransform>,
    truth: Vec<[f32; 4]>,
    lines: BTreeMap<u32, Line>,
    path_points: Trail,
}

impl Shown {
    fn new(context: &Arc<Context>, truth: &[[f32; 4]]) -> Self {
        let topic = |name: &str| ChannelBuilder::new(name).context(context);
        Self {
            _context: Arc::clone(context),
            map: topic("/map").build(),
            path: topic("/path").build(),
            scan: topic("/scan").build(),
            pose: topic("/pose").build(),
            transform: topic("/tf").build(),
            truth: truth.to_vec(),
            lines: BTreeMap::new(),
            path_points: Trail::default(),
        }
    }

    fn take(&mut self, event: &Event) {
        let at = stamp(event.stamp_us);
        match &event.what {
            What::Pose(pose) => self.take_pose(at, pose),
            What::Scan(scan) => self.scan.log(&cloud(at, scan)),
            What::Lines { changed, removed } => {
                self.lines.extend(changed.iter().map(|line| (line.id, *line)));
                self.lines.retain(|id, _| !removed.contains(id));
                self.tell_map(at);
            }
            What::Path(points) => self.path_points.replace(points.iter().map(|point| point.at)),
            What::Began | What::Forgotten => {
                self.lines.clear();
                self.path_points = Trail::default();
                self.tell_map(at);
            }
            // Once a second, for who has come since.
            What::Status(_) => {
                self.tell_map(at);
                self.tell_path(at);
            }
            What::Places(_) | What::Note(_) | What::Playback(_) => {}
        }
    }

    fn take_pose(&mut self, at: Timestamp, robot: &RobotPose) {
        let [x, y, heading] = robot.at;
        self.path_points.push([x, y]);
        let (position, orientation) = (vector(x, y), turned(heading));
        let pose = Pose { position: Some(position), orientation: Some(orientation) };
        self.pose.log(&PoseInFrame { timestamp: Some(at), frame_id: MAP.into(), pose: Some(pose) });
        self.transform.log(&FrameTransform {
            timestamp: Some(at),
            parent_frame_id: MAP.into(),
            child_frame_id: BASE.into(),
            translation: Some(position),
            rotation: Some(orientation),
        });
    }

    /// Whole scenes are not put together for nobody.
    fn tell_map(&self, at: Timestamp) {
        if self.map.has_sinks() {
            self.map.log(&self.map_scene(at));
        }
    }

    fn tell_path(&self, at: Timestamp) {
        if self.path.has_sinks() {
            self.path.log(&self.path_scene(at));
        }
    }

    fn map_scene(&self, at: Timestamp) -> SceneUpdate {
        let ends =
            |walls: bool| self.lines.values().filter(move |line| line.wall == walls).map(|line| line.ends);
        let lines = vec![
            list(ends(true), WALL, WALL_PX),
            list(ends(false), TENTATIVE, THIN_PX),
            list(self.truth.iter().copied(), TRUTH, THIN_PX),
        ];
        scene(at, "map", lines)
    }

    fn path_scene(&self, at: Timestamp) -> SceneUpdate {
        let points = self.path_points.points().iter().map(|[x, y]| point(*x, *y)).collect();
        scene(at, "path", vec![primitive(Type::LineStrip, points, PATH, THIN_PX)])
    }
}

fn stamp(us: u64) -> Timestamp {
    Timestamp::new((us / 1_000_000) as u32, (us % 1_000_000) as u32 * 1000)
}

/// An entity takes the place of the one before with its name.
fn scene(at: Timestamp, id: &str, lines: Vec<LinePrimitive>) -> SceneUpdate {
    let entity = SceneEntity {
        timestamp: Some(at),
        frame_id: MAP.into(),
        id: id.into(),
        lines,
        ..SceneEntity::default()
    };
    SceneUpdate { deletions: Vec::new(), entities: vec![entity] }
}

fn list(ends: impl Iterator<Item = [f32; 4]>, color: Color, thickness: f64) -> LinePrimitive {
    let points = ends.flat_map(|[ax, ay, bx, by]| [point(ax, ay), point(bx, by)]).collect();
    primitive(Type::LineList, points, color, thickness)
}

fn primitive(kind: Type, points: Vec<Point3>, color: Color, thickness: f64) -> LinePrimitive {
    LinePrimitive {
        r#type: kind.into(),
        thickness,
        scale_invariant: true,
        points,
        color: Some(color),
        ..LinePrimitive::default()
    }
}

fn cloud(at: Timestamp, scan: &Scan) -> PointCloud {
    let [x, y, heading] = scan.at;
    let field = |name: &str, number: u32| PackedElementField {
        name: name.into(),
        offset: number * FLOAT,
        r#type: NumericType::Float32.into(),
    };
    let metres = |mm: &[i32; 2]| [mm[0] as f32 / 1000.0, mm[1] as f32 / 1000.0, 0.0];
    let data: Vec<u8> = scan.points_mm.iter().flat_map(metres).flat_map(f32::to_le_bytes).collect();
    PointCloud {
        timestamp: Some(at),
        frame_id: MAP.into(),
        pose: Some(Pose { position: Some(vector(x, y)), orientation: Some(turned(heading)) }),
        point_stride: 3 * FLOAT,
        fields: [("x", 0), ("y", 1), ("z", 2)].map(|(name, number)| field(name, number)).into(),
        data: data.into(),
    }
}

fn point(x: f32, y: f32) -> Point3 {
    Point3 { x: x.into(), y: y.into(), z: 0.0 }
}

fn vector(x: f32, y: f32) -> Vector3 {
    Vector3 { x: x.into(), y: y.into(), z: 0.0 }
}

fn turned(heading: f32) -> Quaternion {
    let half = f64::from(heading) * 0.5;
    Quaternion { x: 0.0, y: 0.0, z: half.sin(), w: half.cos() }
}

#[cfg(test)]
mod tests {
    use std::net::TcpStream;
    use std::sync::Mutex;
    use std::time::Duration;

    use foxglove::{Decode, Metadata, RawChannel, Sink, SinkId};
    use slam_core::tracking::TrackingState;
    use tungstenite::client::IntoClientRequest;

    use super::super::source::{About, Kind};
    use super::*;

    /// Keeps what is sent, with its topic.
    struct Kept {
        id: SinkId,
        messages: Mutex<Vec<(String, Vec<u8>)>>,
    }

    impl Kept {
        fn of(context: &Context) -> Arc<Self> {
            let kept = Arc::new(Self { id: SinkId::next(), messages: Mutex::default() });
            assert!(context.add_sink(kept.clone()));
            kept
        }

        /// The last one of a topic.
        fn last<M: Decode>(&self, topic: &str) -> M {
            let messages = self.messages.lock().unwrap();
            let (_, bytes) = messages.iter().rfind(|(name, _)| name == topic).unwrap();
            M::decode(bytes.as_slice()).ok().unwrap()
        }
    }

    impl Sink for Kept {
        fn id(&self) -> SinkId {
            self.id
        }

        fn log(&self, channel: &RawChannel, message: &[u8], _: &Metadata) -> Result<(), FoxgloveError> {
            self.messages.lock().unwrap().push((channel.topic().into(), message.into()));
            Ok(())
        }
    }

    fn event(stamp_us: u64, what: What) -> Event {
        Event { stamp_us, what }
    }

    fn pose(x: f32) -> What {
        What::Pose(RobotPose { at: [x, 2.0, 1.0], covariance: [0.0; 6], state: TrackingState::Tracking })
    }

    fn line(id: u32, wall: bool) -> Line {
        Line { id, ends: [0.0, 0.0, id as f32, 1.0], hits: 3, wall }
    }

    fn ends(scene: &SceneUpdate) -> Vec<Vec<[f64; 2]>> {
        let lists = scene.entities[0].lines.iter();
        lists.map(|list| list.points.iter().map(|p| [p.x, p.y]).collect()).collect()
    }

    #[test]
    fn a_scene_has_the_walls_that_stand_the_rest_and_the_truth() {
        let context = Context::new();
        let kept = Kept::of(&context);
        let mut shown = Shown::new(&context, &[[5.0, 6.0, 7.0, 8.0]]);
        let changed = vec![line(1, true), line(2, false), line(3, true)];
        shown.take(&event(1, What::Lines { changed, removed: vec![] }));
        shown.take(&event(2_000_003, What::Lines { changed: vec![line(2, true)], removed: vec![3] }));
        let scene: SceneUpdate = kept.last("/map");
        let at = scene.entities[0].timestamp.unwrap();
        assert_eq!((at.sec(), at.nsec()), (2, 3000));
        let walls = vec![[0.0, 0.0], [1.0, 1.0], [0.0, 0.0], [2.0, 1.0]];
        assert_eq!(ends(&scene), [walls, vec![], vec![[5.0, 6.0], [7.0, 8.0]]]);
        shown.take(&event(3_000_000, What::Forgotten));
        assert!(ends(&kept.last("/map"))[0].is_empty());
    }

    #[test]
    fn pose_and_scan_are_where_the_robot_is() {
        let context = Context::new();
        let kept = Kept::of(&context);
        let mut shown = Shown::new(&context, &[]);
        shown.take(&event(1, pose(3.0)));
        shown.take(&event(2, What::Scan(Scan { at: [3.0, 2.0, 1.0], points_mm: vec![[1500, -250]] })));
        let transform: FrameTransform = kept.last("/tf");
        let at = transform.translation.unwrap();
        assert_eq!((at.x, at.y, transform.child_frame_id.as_str()), (3.0, 2.0, BASE));
        assert!((2.0 * transform.rotation.unwrap().z.asin() - 1.0).abs() < 1e-6);
        let stamped: PoseInFrame = kept.last("/pose");
        assert_eq!(stamped.pose.unwrap().position.unwrap().x, 3.0);
        let cloud: PointCloud = kept.last("/scan");
        let metres: Vec<f32> =
            cloud.data.chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect();
        assert_eq!((metres, cloud.point_stride), (vec![1.5, -0.25, 0.0], 12));
    }

    #[test]
    fn topics_are_advertised_on_this_computer_and_all_is_handed_on() {
        let about = About {
            title: "test".into(),
            subtitle: String::new(),
            kind: Kind::Robot,
            base_from_laser: [0.0; 3],
            blueprint: Vec::new(),
            paced: false,
        };
        let (source, feed) = channel(about);
        let (mut outer, server) = tee(source, 0).unwrap();
        feed.send(7, pose(1.0)).unwrap();
        assert_eq!(outer.events.blocking_recv(), Some(event(7, pose(1.0))));

        let stream = TcpStream::connect(("127.0.0.1", server.port())).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
        let mut request = format!("ws://127.0.0.1:{}", server.port()).into_client_request().unwrap();
        request.headers_mut().insert("sec-websocket-protocol", "foxglove.sdk.v1".parse().unwrap());
        let (mut socket, _) = tungstenite::client(request, stream).unwrap();
        let mut said = String::new();
        while !["/map", "/path", "/scan", "/pose", "/tf"]
            .iter()
            .all(|topic| said.contains(&format!("\"{topic}\"")))
        {
            said += socket.read().unwrap().to_text().unwrap();
        }
        assert!(said.contains("foxglove.SceneUpdate") && said.contains("\"lineslam\""));
    }
}
