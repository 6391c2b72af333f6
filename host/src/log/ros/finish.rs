//! The end of a bag: topics are chosen, the mounting is put in, and the user is told what was odd.

use std::collections::HashMap;

use super::collect::Collector;
use super::scan::divided_field;
use super::topics::counted;
use super::transforms::BASES;
use crate::log::{LogError, Records};

impl Collector<'_> {
    /// The records of what is chosen, and what the user should know.
    pub fn finish(mut self) -> Result<Records, LogError> {
        self.say_damage()?;
        if let Some(robot) = self.robot.take() {
            robot.finish(&mut self.records);
            return Ok(self.records);
        }
        self.check_scans()?;
        let choice = self.choose_odometry()?;
        let child = self.take_odometry(choice);
        self.mount(child.as_deref());
        self.mend_stamps();
        self.doubt_step();
        Ok(self.records)
    }

    fn say_damage(&mut self) -> Result<(), LogError> {
        let scans = counted(self.records.scans.len(), "scan");
        for note in std::mem::take(&mut self.damage.notes) {
            self.warn("damaged", format!("{note}; {scans} could be read"));
        }
        let Some((place, what)) = self.damage.first.clone() else { return Ok(()) };
        if self.records.scans.is_empty() && !self.ambiguous {
            return Err(LogError::Damaged { path: self.path.to_owned(), place, what });
        }
        let more = match self.damage.places {
            1 => String::new(),
            places => format!(", and so is it at {} more", counted(places - 1, "place")),
        };
        self.warn("damaged", format!("the bag is damaged: {place}: {what}{more}; {scans} could be read"));
        Ok(())
    }

    /// Puts the mounting into the geometries.
    fn mount(&mut self, child: Option<&str>) {
        let mut bases: Vec<&str> = child.into_iter().collect();
        bases.extend(BASES.iter().filter(|base| Some(**base) != child));
        let mut known = HashMap::new();
        for (geometry, frame) in self.records.geometries.iter_mut().zip(&self.frames) {
            let mounted = known.entry(frame.clone()).or_insert_with(|| {
                // What odometry names is believed before the usual names.
                bases.iter().find_map(|base| self.tree.mounted(base, frame))
            });
            if let Some(mounted) = mounted {
                geometry.base_from_laser = Some(mounted.base_from_laser);
                geometry.upside_down = mounted.upside_down;
            }
        }
        let mut said: Vec<_> = known.into_iter().collect();
        said.sort_by(|a, b| a.0.cmp(&b.0));
        for (frame, mounted) in said.into_iter().take(4) {
            match mounted {
                None => {
                    let base = child.unwrap_or("base_footprint or base_link");
                    self.warn(
                        "mounting_unknown",
                        format!(
                            "no transform of the bag tells where the scanner's frame '{frame}' is in {base}: a robot file's \
                             [mounting] says it"
                        ),
                    );
                }
                Some(mounted) => {
                    if let Some(tilt) = mounted.tilt_deg {
                        self.warn(
                            "tilted_scanner",
                            format!(
                                "the scanner's frame '{frame}' is tilted by {tilt:.1}° from the level: its scans are used as \
                                 if it were not"
                            ),
                        );
                    }
                }
            }
        }
    }

    /// Scans without stamps get the recorder's.
    fn mend_stamps(&mut self) {
        let Some(recorded) = self.recorded_us.take().filter(|r| !r.is_empty()) else { return };
        for (scan, stamp_us) in self.records.scans.iter_mut().zip(recorded) {
            scan.stamp_us = stamp_us;
        }
        self.warn(
            "recorder_stamps",
            "the scans' own stamps are all zero: those of the recorder are used, which are later and less regular",
        );
    }

    fn doubt_step(&mut self) {
        let Some(scan) = self.records.scans.first() else { return };
        let beams = scan.ranges_mm.len();
        let step_rad = scan.geometry.and_then(|index| self.records.geometries.get(index)).map(|g| g.step_rad);
        let Some(step_rad) = step_rad.filter(|step| divided_field(beams, *step)) else { return };
        let carmen = if beams == 180 { "1" } else { "0.5" };
        self.warn(
            "angle_increment",
            format!(
                "angle_increment is {:.6}°, 180° divided by {beams} beams less one; if the scans are a SICK's from a CARMEN \
                 log, its beams are {carmen}° apart. The log's value was used; a robot file with [sensor.field], like \
                 robots/sick.toml, overrules it",
                step_rad.abs().to_degrees()
            ),
        );
    }
}
