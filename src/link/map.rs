//! The map on its way out: a block at a time, its changed lines, then its check.

use ::link::FromRobot;
use ::link::from_robot::{Block, Lines, Places, PlacesEnd};
use ::link::map::{BLOCK, Check, Line, PLACES};
use heapless::Vec;
use slam_core::geometry::math::sqrt;
use slam_core::geometry::pose::components;

use crate::kept::{Mapper, ROOM};

/// Which lines a PC has. For each slot a byte of what was sent last, 0 where nothing was: a change that leaves it as it is, one in 255, is
/// noticed by the PC, which has another check then and asks.
pub struct MapCursor {
    sent: [u8; ROOM[0]],
    block: usize,
    is_open: bool,
    /// Places that were sent, of those that stood when so many loops had been closed.
    places: usize,
    loops_closed: u32,
}

impl MapCursor {
    /// Nothing was sent.
    pub const fn new() -> Self {
        Self { sent: [0; ROOM[0]], block: 0, is_open: false, places: 0, loops_closed: 0 }
    }

    /// The next block may be sent, where the map is wanted.
    pub fn open(&mut self, wanted: bool) {
        self.is_open = wanted;
    }

    /// Whether there may be something to send.
    pub fn is_open(&self) -> bool {
        self.is_open
    }

    /// Has blocks sent again, and places.
    pub fn repeat(&mut self, blocks: u32, places: bool) {
        for (block, sent) in self.sent.chunks_mut(BLOCK).enumerate() {
            if blocks >> block & 1 != 0 {
                sent.fill(0);
            }
        }
        if places {
            self.places = 0;
        }
    }

    /// The next message. Work: that of [`Slam::is_wall`](slam_core::Slam::is_wall) for the lines of a block, and their CRC.
    #[inline(never)]
    pub fn next(&mut self, mapper: &Mapper) -> Option<FromRobot> {
        if !self.is_open {
            return None;
        }
        let lines = mapper.slam().map().segments().len();
        let from = self.block * BLOCK;
        if from >= lines.max(1) {
            return Some(self.next_places(mapper));
        }
        if let Some(changed) = self.changed(mapper, from) {
            return Some(FromRobot::Lines(changed));
        }
        self.is_open = false;
        let block = Block { block: self.block as u8, lines: lines as u16, check: check(mapper, from) };
        self.block += 1;
        Some(FromRobot::Block(block))
    }

    /// Lines of a block that are not as they were sent.
    fn changed(&mut self, mapper: &Mapper, from: usize) -> Option<Lines> {
        let mut lines = Lines::default();
        for (slot, sent) in self.sent.iter_mut().enumerate().skip(from).take(BLOCK) {
            let Some(line) = line(mapper, slot) else {
                *sent = 0;
                continue;
            };
            let mark = (line.check() as u8).max(1);
            if *sent != mark {
                if lines.0.push((slot as u16, line)).is_err() {
                    break;
                }
                *sent = mark;
            }
        }
        (!lines.0.is_empty()).then_some(lines)
    }

    /// Places that were not sent; after the last one, how all are.
    fn next_places(&mut self, mapper: &Mapper) -> FromRobot {
        let (places, loops_closed) = (mapper.slam().places(), mapper.slam().counters().loops_closed);
        let anchors = places.anchors();
        if core::mem::replace(&mut self.loops_closed, loops_closed) != loops_closed
            || self.places > anchors.len()
        {
            self.places = 0;
        }
        let poses = || anchors.iter().map(|anchor| components(&anchor.pose()).into());
        let some: Vec<[f32; 3], PLACES> = poses().skip(self.places).take(PLACES).collect();
        if !some.is_empty() {
            let first = self.places as u16;
            self.places += some.len();
            return FromRobot::Places(Places { first, poses: some });
        }
        (self.block, self.is_open) = (0, false);
        let mut check = Check::default();
        poses().for_each(|pose: [f32; 3]| check.take_place(&pose));
        let loops = places.loops().iter().map(|edge| (edge.from, edge.to)).collect();
        FromRobot::PlacesEnd(PlacesEnd { places: anchors.len() as u16, check: check.check(), loops })
    }
}

fn check(mapper: &Mapper, from: usize) -> u32 {
    let mut check = Check::default();
    (from..from + BLOCK).map_while(|slot| line(mapper, slot)).for_each(|line| check.take_line(&line));
    check.check()
}

fn line(mapper: &Mapper, slot: usize) -> Option<Line> {
    let slam = mapper.slam();
    let entry = slam.map().segments().get(slot)?;
    let segment = entry.segment();
    Some(Line {
        start_m: [segment.start.x, segment.start.y],
        end_m: [segment.end.x, segment.end.y],
        sigma_m: sqrt(1.0 / segment.moments.weight),
        hits: entry.hits,
        is_wall: slam.is_wall(slot),
    })
}
