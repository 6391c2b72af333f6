//! The robot's map, as far as it has been said.

use std::collections::{BTreeMap, BTreeSet};

use ::link::map::{BLOCK, Line, block_check, places_check};
use ::link::{Command, FromRobot};

/// A copy of the map that knows what it lacks.
#[derive(Clone, Debug, Default)]
pub struct MapCopy {
    lines: BTreeMap<u16, Line>,
    places: BTreeMap<u16, [f32; 3]>,
    loops: Vec<(u16, u16)>,
    /// Blocks whose check was right when it was last said.
    right: BTreeSet<u8>,
    blocks: usize,
    places_are_right: bool,
}

impl MapCopy {
    /// Takes what a message says of the map. Where that shows that something was missed: what to ask for.
    pub fn take(&mut self, message: &FromRobot) -> Option<Command> {
        match message {
            FromRobot::Lines(lines) => self.lines.extend(lines.0.iter().copied()),
            FromRobot::Places(places) => {
                self.places.extend((places.first..).zip(places.poses.iter().copied()));
            }
            FromRobot::Block(block) => {
                self.lines.retain(|slot, _| *slot < block.lines);
                self.blocks = usize::from(block.lines).div_ceil(BLOCK).max(1);
                let blocks = self.blocks;
                self.right.retain(|right| usize::from(*right) < blocks);
                let from = u16::from(block.block).saturating_mul(BLOCK as u16);
                let to = from.saturating_add(BLOCK as u16);
                if block_check(self.lines.range(from..to).map(|(_, line)| line)) == block.check {
                    self.right.insert(block.block);
                } else {
                    self.right.remove(&block.block);
                    let blocks = 1u32.checked_shl(block.block.into()).unwrap_or(0);
                    return Some(Command::SendMap { blocks, places: false });
                }
            }
            FromRobot::PlacesEnd(end) => {
                self.places.retain(|index, _| *index < end.places);
                self.loops = end.loops.to_vec();
                self.places_are_right = places_check(self.places.values()) == end.check;
                if !self.places_are_right {
                    return Some(Command::SendMap { blocks: 0, places: true });
                }
            }
            // What a robot that has been reset has of its map comes again, and what is as it was is right.
            FromRobot::Hello(_) => (self.right, self.places_are_right) = (BTreeSet::new(), false),
            _ => {}
        }
        None
    }

    /// Whether all of it is as it was on the robot when that was last said.
    pub fn is_whole(&self) -> bool {
        self.blocks > 0 && self.right.len() == self.blocks && self.places_are_right
    }

    /// Lines, with their slots on the robot.
    pub fn lines(&self) -> impl Iterator<Item = (u16, &Line)> {
        self.lines.iter().map(|(slot, line)| (*slot, line))
    }

    /// Poses (x, y in metres, θ in radians) of the places, oldest first.
    pub fn places(&self) -> impl Iterator<Item = &[f32; 3]> {
        self.places.values()
    }

    /// Loops: indices of the older and the younger place.
    pub fn loops(&self) -> &[(u16, u16)] {
        &self.loops
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ::link::from_robot::{Block, Lines, Places, PlacesEnd};

    fn line(x: f32) -> Line {
        Line { start_m: [x, 0.0], end_m: [x, 1.0], sigma_m: 0.01, hits: 4, is_wall: true }
    }

    fn said(lines: &[(u16, Line)]) -> FromRobot {
        FromRobot::Lines(Lines(lines.iter().copied().collect()))
    }

    fn block(block: u8, all: &[Line]) -> FromRobot {
        let from = usize::from(block) * BLOCK;
        let check = block_check(all.iter().skip(from).take(BLOCK));
        FromRobot::Block(Block { block, lines: all.len() as u16, check })
    }

    #[test]
    fn what_was_missed_is_asked_for_until_it_is_there() {
        let all: Vec<Line> = (0..40u8).map(|k| line(k.into())).collect();
        let mut copy = MapCopy::default();
        let slots: Vec<(u16, Line)> = (0..).zip(all.iter().copied()).collect();
        for some in slots.chunks(8) {
            // One message of the second block never arrives.
            if some[0].0 != 32 {
                assert_eq!(copy.take(&said(some)), None);
            }
        }
        assert_eq!(copy.take(&block(0, &all)), None);
        let again = Command::SendMap { blocks: 2, places: false };
        assert_eq!(copy.take(&block(1, &all)), Some(again));
        assert!(!copy.is_whole());
        copy.take(&said(&slots[32..]));
        assert_eq!(copy.take(&block(1, &all)), None);
        let mut end =
            PlacesEnd { places: 1, check: places_check([&[1.0, 2.0, 3.0]]), ..PlacesEnd::default() };
        let places = Command::SendMap { blocks: 0, places: true };
        assert_eq!(copy.take(&FromRobot::PlacesEnd(end.clone())), Some(places));
        copy.take(&FromRobot::Places(Places { first: 0, poses: [[1.0, 2.0, 3.0]].into_iter().collect() }));
        end.loops.push((0, 0)).unwrap();
        assert_eq!(copy.take(&FromRobot::PlacesEnd(end)), None);
        assert!(copy.is_whole());
        assert_eq!(copy.lines().map(|(_, line)| *line).collect::<Vec<_>>(), all);
        assert_eq!((copy.places().count(), copy.loops().len()), (1, 1));
        // A map that has shrunk, in which the last line took the place of the first.
        let fewer = [all[39], all[1], all[2]];
        copy.take(&said(&[(0, all[39])]));
        assert_eq!(copy.take(&block(0, &fewer)), None);
        assert!(copy.is_whole());
        assert_eq!(copy.lines().map(|(_, line)| *line).collect::<Vec<_>>(), fewer);
    }
}
