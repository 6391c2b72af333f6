//! How the robot does, in plain words: facts, counters, and where something is wrong what to do about it.

use serde::Serialize;
use slam_core::map::MapCounters;
use slam_core::mapper::MapperCounters;
use slam_core::odometry::delay::Delay;
use slam_core::odometry::wheel_faults::WheelFault;
use slam_core::slam::Counters;
use slam_core::tracking::TrackingState;

use super::source::Weight;

/// A map fuller than this is said to be nearly full.
const NEARLY_FULL: f32 = 0.95;
/// Scans per second below this are too few for a robot that drives.
const FEW_SCANS_PER_S: f32 = 2.0;

/// A number that a source counts besides what the core does: a link's losses, a sensor's errors.
#[derive(Clone, Debug, PartialEq)]
pub struct Counter {
    /// Its name.
    pub name: &'static str,
    /// Since the start.
    pub count: u64,
    /// What it means.
    pub meaning: &'static str,
    /// What to do where it grows; empty where nothing is wrong.
    pub remedy: &'static str,
}

/// How the robot does.
#[derive(Clone, Debug, PartialEq)]
pub struct Status {
    /// How far the pose is to be relied on.
    pub state: TrackingState,
    /// Whether the map learns.
    pub mapping: bool,
    /// Share of the last scan that the map explains, where it is known.
    pub support: Option<f32>,
    /// Scans a second, by their stamps.
    pub scans_per_s: f32,
    /// Time that a scan takes where the core runs, microseconds.
    pub scan_us: u32,
    /// Way driven, metres.
    pub way_m: f32,
    /// Lines of the map, and how many there is room for.
    pub lines: [u32; 2],
    /// The same of places.
    pub places: [u32; 2],
    /// Counters of the core.
    pub core: Counters,
    /// Counters of the map.
    pub map: MapCounters,
    /// Counters of odometry and stamps.
    pub odometry: MapperCounters,
    /// What is wrong with the wheels.
    pub wheel_fault: Option<WheelFault>,
    /// Whether the odometry is of no use.
    pub odometry_useless: bool,
    /// By how much scans are stamped late.
    pub delay: Option<Delay>,
    /// What the source counts.
    pub more: Vec<Counter>,
}

/// A line of the status.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Fact {
    /// What.
    pub name: &'static str,
    /// How much.
    pub value: String,
}

/// Something that is wrong.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Trouble {
    /// How much it matters.
    pub weight: Weight,
    /// What.
    pub what: String,
    /// What to do.
    pub remedy: &'static str,
}

/// Troubles that have been told, so that each is told once while it lasts.
#[derive(Clone, Debug, Default)]
pub struct Troubles(Vec<&'static str>);

impl Troubles {
    /// Those that have not been told yet.
    pub fn new_in(&mut self, status: &Status) -> Vec<Trouble> {
        let troubles = status.troubles();
        let now: Vec<&'static str> = troubles.iter().map(|trouble| trouble.remedy).collect();
        let told = std::mem::replace(&mut self.0, now);
        troubles.into_iter().filter(|trouble| !told.contains(&trouble.remedy)).collect()
    }
}

/// A counter that is not zero.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Counted {
    /// Its name.
    pub name: &'static str,
    /// How often.
    pub count: u64,
    /// What it means.
    pub meaning: &'static str,
}

impl Status {
    /// What a person wants to know first.
    pub fn facts(&self) -> Vec<Fact> {
        let of = |[count, room]: [u32; 2]| format!("{count} of {room}");
        let mut facts = vec![
            Fact { name: "Driven", value: format!("{:.1} m", self.way_m) },
            Fact { name: "Scans", value: format!("{:.1} per second", self.scans_per_s) },
            Fact { name: "Time for a scan", value: milliseconds(self.scan_us) },
            Fact { name: "Map lines", value: of(self.lines) },
            Fact { name: "Places", value: of(self.places) },
            Fact { name: "Loops closed", value: self.core.loops_closed.to_string() },
            Fact { name: "Map", value: if self.mapping { "learns" } else { "frozen" }.into() },
        ];
        if let Some(support) = self.support {
            facts.insert(1, Fact { name: "Scan explained", value: format!("{:.0} %", 100.0 * support) });
        }
        if let Some(delay) = self.delay.filter(|delay| delay.used) {
            facts.push(Fact {
                name: "Scans stamped late by",
                value: format!("{:.0} ms", 1e3 * delay.delay_s),
            });
        }
        facts
    }

    /// What is wrong now, the worst first.
    pub fn troubles(&self) -> Vec<Trouble> {
        let mut troubles: Vec<Trouble> =
            [self.of_state(), self.of_wheels(), self.of_room()].into_iter().flatten().collect();
        if self.core.scans > 20 && self.scans_per_s < FEW_SCANS_PER_S {
            troubles.push(Trouble {
                weight: Weight::Warning,
                what: format!("Only {:.1} scans come in a second.", self.scans_per_s),
                remedy: "Check the scanner's cable and supply.",
            });
        }
        if self.core.wrong_beam_count > 0 {
            troubles.push(Trouble {
                weight: Weight::Warning,
                what: format!(
                    "{} scans had another number of beams than the scanner has.",
                    self.core.wrong_beam_count
                ),
                remedy: "Check that the robot file names the right scanner.",
            });
        }
        troubles.extend(self.more.iter().filter(|c| c.count > 0 && !c.remedy.is_empty()).map(|counter| {
            Trouble {
                weight: Weight::Warning,
                what: format!("{}: {}.", counter.name, counter.count),
                remedy: counter.remedy,
            }
        }));
        troubles.sort_by_key(|trouble| trouble.weight != Weight::Error);
        troubles
    }

    fn of_state(&self) -> Option<Trouble> {
        match self.state {
            TrackingState::Tracking => None,
            TrackingState::Uncertain => Some(Trouble {
                weight: Weight::Warning,
                what: "The robot is not sure where it is.".into(),
                remedy: "Drive slowly past walls that are in the map; glass and crowds explain nothing.",
            }),
            TrackingState::Lost => Some(Trouble {
                weight: Weight::Error,
                what: "The robot does not know where it is. Nothing enters the map.".into(),
                remedy: "Drive a few metres through rooms that are in the map: it looks for itself. Or set its pose.",
            }),
        }
    }

    fn of_wheels(&self) -> Option<Trouble> {
        let trouble = |weight, what, remedy| Some(Trouble { weight, what, remedy });
        match self.wheel_fault {
            Some(fault) => trouble(
                Weight::Error,
                format!("The wheels contradict the scanner: {}.", fault.message()),
                "Stop, and check the encoders' wiring: A and B, left and right, connectors.",
            ),
            None if self.odometry_useless => trouble(
                Weight::Warning,
                "The wheels say nothing useful; the scanner is followed alone.".into(),
                "Check wheels, floor and encoders; drive slowly.",
            ),
            None => None,
        }
    }

    fn of_room(&self) -> Option<Trouble> {
        let [lines, room] = self.lines;
        let trouble = |what| {
            Some(Trouble {
                weight: Weight::Warning,
                what,
                remedy: "Save the map, and begin a new one for another part of the building.",
            })
        };
        if self.map.evicted + self.map.refused > 0 {
            return trouble(format!(
                "The map is full: {} lines gave way to others.",
                self.map.evicted + self.map.refused
            ));
        }
        if lines as f32 > NEARLY_FULL * room as f32 {
            return trouble(format!("The map is nearly full: {lines} lines of {room}."));
        }
        None
    }

    /// Counters that are not zero.
    pub fn counted(&self) -> Vec<Counted> {
        let Self { core, map, odometry, .. } = self;
        let own = [
            ("scans", core.scans, "taken in since the start"),
            ("wrong beam count", core.wrong_beam_count, "scans that were not used"),
            ("without segments", core.without_segments, "scans in which no straight wall was seen"),
            ("uncorrected", core.uncorrected, "scans that left the pose to the wheels"),
            ("searched", core.searched, "scans for which the pose was searched around the prediction"),
            ("lost", core.lost, "scans at which the robot did not know where it was"),
            ("found again", core.relocalised, "times that it found itself in its map"),
            ("gave up", core.gave_up, "times that it did not, and went on from where it was thought to be"),
            ("loops closed", core.loops_closed, "times that places were corrected"),
            ("coasted", core.coasted, "moves by the wheels alone, while scans stayed away"),
            ("wheels overruled", core.odometry_left_out, "scans that contradicted a wild step of the wheels"),
            ("bad motion", core.bad_motion, "motions that were no numbers"),
            ("crowded out", core.crowded_out, "segments that one scan had too many"),
            ("lines added", map.added, "to the map"),
            ("lines fused", map.fused, "that became one with another"),
            ("lines forgotten", map.forgotten, "that beams went through again and again"),
            ("openings", map.opened, "cut into lines"),
            ("lines evicted", map.evicted, "that gave way to others in a full map"),
            ("lines refused", map.refused, "that found no room"),
            (
                "stamps refused",
                odometry.stamps_refused,
                "samples of the wheels whose stamps did not increase",
            ),
            ("scans without odometry", odometry.scans_without_odometry, "that were passed over"),
            ("impossible steps", odometry.impossible_steps, "of the wheels, that no robot can make"),
            ("counters restarted", odometry.counters_restarted, "both wheels' counters stood near zero"),
            ("resumed", odometry.resumed, "times that the map was taken up after a reset"),
        ];
        let own = own.map(|(name, count, meaning)| Counted { name, count: count.into(), meaning });
        let more = self.more.iter().map(|c| Counted { name: c.name, count: c.count, meaning: c.meaning });
        own.into_iter().chain(more).filter(|counted| counted.count > 0).collect()
    }
}

fn milliseconds(us: u32) -> String {
    format!("{:.2} ms", f64::from(us) * 1e-3)
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    pub fn well() -> Status {
        Status {
            state: TrackingState::Tracking,
            mapping: true,
            support: Some(0.97),
            scans_per_s: 10.0,
            scan_us: 412,
            way_m: 12.34,
            lines: [37, 512],
            places: [4, 96],
            core: Counters { scans: 120, ..Counters::default() },
            map: MapCounters::default(),
            odometry: MapperCounters::default(),
            wheel_fault: None,
            odometry_useless: false,
            delay: None,
            more: Vec::new(),
        }
    }

    #[test]
    fn a_robot_that_is_well_has_no_trouble() {
        assert_eq!(well().troubles(), []);
        let facts: Vec<String> = well().facts().iter().map(|f| format!("{}: {}", f.name, f.value)).collect();
        assert!(facts.contains(&"Driven: 12.3 m".to_owned()), "{facts:?}");
        assert!(facts.contains(&"Map lines: 37 of 512".to_owned()), "{facts:?}");
        assert_eq!(well().counted().iter().map(|c| c.name).collect::<Vec<_>>(), ["scans"]);
    }

    #[test]
    fn each_trouble_says_what_to_do_and_errors_come_first() {
        let link =
            Counter { name: "Link losses", count: 3, meaning: "frames", remedy: "Check the USB cable." };
        let status = Status {
            state: TrackingState::Lost,
            wheel_fault: Some(WheelFault::LeftDead),
            scans_per_s: 1.0,
            lines: [500, 512],
            more: vec![link],
            ..well()
        };
        let troubles = status.troubles();
        assert_eq!(troubles.len(), 5, "{troubles:?}");
        assert!(troubles.iter().all(|trouble| trouble.remedy.ends_with('.')));
        assert!(troubles[..2].iter().all(|trouble| trouble.weight == Weight::Error), "{troubles:?}");
        assert!(troubles[1].what.contains("the left encoder is dead"));
        let full = Status { map: MapCounters { evicted: 7, ..MapCounters::default() }, ..well() };
        assert!(full.troubles()[0].what.contains("7 lines gave way"));
    }
}
