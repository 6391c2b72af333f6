//! `map.json`: a map to go on in, or to find one's way in.

use std::path::{Path, PathBuf};

use nalgebra::{Isometry2, Vector3};
use serde::{Deserialize, Serialize};
use slam_core::Mapper;
use slam_core::Slam;
use slam_core::map::store::{MapError, StoredLine, StoredLoop, StoredMap, StoredPlace, VERSION};
use slam_core::odometry::bias::OdometryBias;

/// What a file of this kind says it is.
const FORMAT: &str = "lineslam map";

/// The file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MapFile {
    /// Where it was read.
    #[serde(skip)]
    path: PathBuf,
    format: String,
    version: u16,
    /// Way driven until then, metres.
    pub way_m: f32,
    /// Errors of the odometry: of the distance and of the turn, relative, and of the turn for each metre, radians.
    pub odometry_bias: [f32; 3],
    /// Walls.
    pub lines: Vec<StoredLine>,
    /// Places, in the order in which the robot came to them.
    pub places: Vec<StoredPlace>,
    /// Loops between them.
    pub loops: Vec<StoredLoop>,
}

/// The head of a file, whatever its version.
#[derive(Deserialize)]
struct Head {
    format: Option<String>,
    version: Option<u16>,
}

/// Why a map cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum MapFileError {
    /// It cannot be read.
    #[error("{}", .0.display())]
    Read(PathBuf, #[source] std::io::Error),
    /// It is no JSON, or lacks something.
    #[error("{}", .0.display())]
    Json(PathBuf, #[source] serde_json::Error),
    /// It is something else.
    #[error("{}: this is not a lineslam map: its \"format\" is {found}, expected \"{FORMAT}\"", path.display())]
    Format {
        /// The file.
        path: PathBuf,
        /// What it says.
        found: String,
    },
    /// It is of another version.
    #[error("{}: the map is of version {found}, this program reads version {VERSION}", path.display())]
    Version {
        /// The file.
        path: PathBuf,
        /// What it says.
        found: u16,
    },
    /// The configuration is one that does not go on in a map.
    #[error("--map: only the default configuration goes on in a map, not --config {0}")]
    Configuration(&'static str),
    /// Its numbers make no sense.
    #[error("{}", .0.display())]
    Map(PathBuf, #[source] MapError),
}

impl MapFile {
    /// What a `Slam` knows.
    pub fn of<const N: usize, const BEAMS: usize, const P: usize>(slam: &Slam<N, BEAMS, P>) -> Self {
        Self {
            path: PathBuf::new(),
            format: FORMAT.into(),
            version: VERSION,
            way_m: slam.way_m(),
            odometry_bias: slam.odometry_bias().0.into(),
            lines: slam.stored_lines().collect(),
            places: slam.stored_places().collect(),
            loops: slam.stored_loops().collect(),
        }
    }

    /// Reads a file.
    pub fn load(path: &Path) -> Result<Self, MapFileError> {
        let own = || path.to_owned();
        let text = std::fs::read_to_string(path).map_err(|e| MapFileError::Read(own(), e))?;
        let json = |e| MapFileError::Json(own(), e);
        let head: Head = serde_json::from_str(&text).map_err(json)?;
        if head.format.as_deref() != Some(FORMAT) {
            let found = head.format.map_or_else(|| "missing".into(), |format| format!("{format:?}"));
            return Err(MapFileError::Format { path: own(), found });
        }
        if let Some(found) = head.version.filter(|version| *version != VERSION) {
            return Err(MapFileError::Version { path: own(), found });
        }
        let file: Self = serde_json::from_str(&text).map_err(json)?;
        Ok(Self { path: own(), ..file })
    }

    /// As the core takes it.
    fn stored(&self) -> StoredMap<'_> {
        StoredMap {
            lines: &self.lines,
            places: &self.places,
            loops: &self.loops,
            way_m: self.way_m,
            odometry_bias: OdometryBias(Vector3::from(self.odometry_bias)),
        }
    }

    /// Hands it to a mapper, with the robot at a pose, or anywhere.
    pub fn hand_to<const N: usize, const K: usize, const BEAMS: usize, const P: usize>(
        &self,
        mapper: &mut Mapper<N, K, BEAMS, P>,
        at: Option<Isometry2<f32>>,
    ) -> Result<(), MapFileError> {
        mapper.load(&self.stored(), at).map_err(|e| MapFileError::Map(self.path.clone(), e))
    }

    /// The bytes of the file: a line for each wall, place and loop.
    pub fn render(&self) -> Result<Vec<u8>, serde_json::Error> {
        fn list<T: Serialize>(items: &[T]) -> Result<String, serde_json::Error> {
            let lines: Vec<String> = items.iter().map(serde_json::to_string).collect::<Result<_, _>>()?;
            Ok(if lines.is_empty() { "[]".into() } else { format!("[\n  {}\n ]", lines.join(",\n  ")) })
        }
        let text = format!(
            "{{\n \"format\": {},\n \"version\": {},\n \"way_m\": {},\n \"odometry_bias\": {},\n \"lines\": {},\n \"places\": {},\n \"loops\": {}\n}}\n",
            serde_json::to_string(&self.format)?,
            self.version,
            serde_json::to_string(&self.way_m)?,
            serde_json::to_string(&self.odometry_bias)?,
            list(&self.lines)?,
            list(&self.places)?,
            list(&self.loops)?,
        );
        Ok(text.into_bytes())
    }
}
