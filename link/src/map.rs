//! The map: lines by their slots, in blocks whose checks tell whether both ends have the same.
//!
//! The robot sends a line when it has changed, and after a block's changed lines the check of the whole block as it is then. A PC that
//! has missed a line has another check and asks for the block. So nothing is lost for good, whatever is lost on the way, and
//! neither end keeps a history: the check is the generation of a block, and stays so across resets of both.

use crc::{Digest, Table};
use serde::{Deserialize, Serialize};

use crate::frame::CRC;

/// Slots of a block.
pub const BLOCK: usize = 32;
/// Blocks of the largest map: 1024 lines.
pub const BLOCKS: usize = 32;
/// Lines in one frame.
pub const LINES: usize = 8;
/// Places in one frame.
pub const PLACES: usize = 18;
/// Loops at the most.
pub const LOOPS: usize = 16;

/// A line of the map.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Line {
    /// Where it begins, in `map`, metres; its free side is on the left, …
    pub start_m: [f32; 2],
    /// … and where it ends.
    pub end_m: [f32; 2],
    /// Standard deviation of its distance, metres.
    pub sigma_m: f32,
    /// Keyframes that saw it.
    pub hits: u16,
    /// Whether it is a wall, or still tentative.
    pub is_wall: bool,
}

/// Most bytes of a line.
const LINE_BYTES: usize = 24;

impl Line {
    /// CRC-32 of its bytes.
    pub fn check(&self) -> u32 {
        block_check([self])
    }
}

/// A check on its way.
pub struct Check(Digest<'static, u32, Table<1>>);

impl Default for Check {
    fn default() -> Self {
        Self(CRC.digest())
    }
}

impl Check {
    /// Takes a line of the block.
    pub fn take_line(&mut self, line: &Line) {
        self.take(line);
    }

    /// Takes the pose of a place.
    pub fn take_place(&mut self, pose: &[f32; 3]) {
        self.take(pose);
    }

    /// There is room for either.
    fn take(&mut self, item: &impl Serialize) {
        if let Ok(bytes) = postcard::to_slice(item, &mut [0; LINE_BYTES]) {
            self.0.update(bytes);
        }
    }

    /// What it is.
    pub fn check(self) -> u32 {
        self.0.finalize()
    }
}

/// Check of a block: the CRC-32 of its lines' bytes one after the other.
pub fn block_check<'a>(lines: impl IntoIterator<Item = &'a Line>) -> u32 {
    let mut check = Check::default();
    lines.into_iter().for_each(|line| check.take_line(line));
    check.check()
}

/// Check of all places: the CRC-32 of their poses' bytes.
pub fn places_check<'a>(poses: impl IntoIterator<Item = &'a [f32; 3]>) -> u32 {
    let mut check = Check::default();
    poses.into_iter().for_each(|pose| check.take_place(pose));
    check.check()
}
