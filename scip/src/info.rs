//! Who the sensor is and how its beams lie: what `VV` and `PP` say. Nothing about the geometry is assumed.

use heapless::String;

use crate::command::Steps;
use crate::decoder::Field;

/// Longest text that is kept of a field; what is longer is cut.
pub const TEXT: usize = 48;

/// A sensor's identity and geometry.
#[derive(Clone, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct SensorInfo {
    /// `MODL` of `PP`.
    pub model: String<TEXT>,
    /// `VEND` of `VV`.
    pub vendor: String<TEXT>,
    /// `PROD` of `VV`.
    pub product: String<TEXT>,
    /// `FIRM` of `VV`.
    pub firmware: String<TEXT>,
    /// `PROT` of `VV`.
    pub protocol: String<TEXT>,
    /// `SERI` of `VV`.
    pub serial: String<TEXT>,
    /// Least range, millimetres (`DMIN`). Values below are error codes. 20 where the sensor does not say: codes are below.
    pub min_range_mm: u16,
    /// Greatest range, millimetres (`DMAX`). 65 535 where it is more, or the sensor does not say.
    pub max_range_mm: u16,
    /// Steps in 360° (`ARES`).
    pub steps_per_revolution: u16,
    /// First step that is measured (`AMIN`).
    pub first_step: u16,
    /// Last step that is measured, inclusive (`AMAX`).
    pub last_step: u16,
    /// Step that looks ahead (`AFRT`).
    pub front_step: u16,
    /// Revolutions a minute (`SCAN`).
    pub revolutions_per_minute: u16,
}

/// What is wrong with a sensor's description of itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum InfoError {
    /// A field did not come whose number measuring needs, or is no number.
    Missing {
        /// Its key.
        key: &'static str,
    },
    /// A number that cannot be.
    Impossible {
        /// Its key.
        key: &'static str,
        /// What it says.
        value: u32,
    },
}

impl core::fmt::Display for InfoError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Missing { key } => write!(f, "the sensor does not state {key}, or not as a number"),
            Self::Impossible { key, value } => write!(f, "the sensor states {key} as {value}"),
        }
    }
}

impl core::error::Error for InfoError {}

impl SensorInfo {
    /// Time of one revolution, microseconds.
    pub fn revolution_us(&self) -> u32 {
        60_000_000 / u32::from(self.revolutions_per_minute.max(1))
    }

    /// Time from a scan's stamp, which is at step 0, to a step.
    pub fn step_us(&self, step: u16) -> u64 {
        u64::from(step) * u64::from(self.revolution_us()) / u64::from(self.steps_per_revolution.max(1))
    }

    /// All steps, one by one.
    pub fn all_steps(&self) -> Steps {
        Steps { first: self.first_step, last: self.last_step, cluster: 1 }
    }

    /// Number of values of a scan of all steps.
    pub fn beams(&self) -> usize {
        self.all_steps().values()
    }
}

/// Collects fields until they make a [`SensorInfo`].
#[derive(Clone, Debug, Default)]
pub struct InfoBuilder {
    texts: [String<TEXT>; 6],
    numbers: [Option<u32>; 7],
}

const TEXT_KEYS: [&str; 6] = ["MODL", "VEND", "PROD", "FIRM", "PROT", "SERI"];
/// The limits may be missing.
const NUMBER_KEYS: [&str; 7] = ["DMIN", "DMAX", "ARES", "AMIN", "AMAX", "AFRT", "SCAN"];
/// Values below are codes of the protocol, whatever the sensor (SCIP 2.0, table 3).
const CODES_MM: u16 = 20;

impl InfoBuilder {
    /// Takes a field; one that no [`SensorInfo`] has is passed over.
    pub fn take(&mut self, field: Field<'_>) {
        if let Some(slot) = slot(&TEXT_KEYS, &mut self.texts, field.key) {
            slot.clear();
            for character in field.value.chars() {
                if slot.push(character).is_err() {
                    break;
                }
            }
        }
        if let Some(slot) = slot(&NUMBER_KEYS, &mut self.numbers, field.key) {
            *slot = field.value.trim().parse().ok();
        }
    }

    /// What the fields say, if those are there that measuring needs, and can be true. Texts may be missing, they are empty then;
    /// so may the limits of the range.
    pub fn build(&self) -> Result<SensorInfo, InfoError> {
        let [least, most, geometry @ ..] = self.numbers;
        let [ares, amin, amax, afrt, scan] = needed(geometry)?;
        let min_range_mm = saturated(least.unwrap_or(CODES_MM.into()));
        let max_range_mm = saturated(most.unwrap_or(u32::MAX));
        let fits = [
            ("DMIN", least.unwrap_or(0), min_range_mm < u16::MAX),
            ("DMAX", most.unwrap_or(0), max_range_mm > min_range_mm),
            ("ARES", ares, ares > 0 && ares <= u16::MAX.into()),
            ("AMIN", amin, amin <= amax),
            // `MD` has four digits for a step; and a scan is within one revolution.
            ("AMAX", amax, amax < 10_000 && amax - amin.min(amax) < ares),
            ("AFRT", afrt, (amin..=amax).contains(&afrt)),
            ("SCAN", scan, scan > 0 && scan <= u16::MAX.into()),
        ];
        if let Some(&(key, value, _)) = fits.iter().find(|(_, _, fits)| !fits) {
            return Err(InfoError::Impossible { key, value });
        }
        let [steps_per_revolution, first_step, last_step, front_step, rpm] =
            [ares, amin, amax, afrt, scan].map(saturated);
        let [model, vendor, product, firmware, protocol, serial] = self.texts.clone();
        Ok(SensorInfo {
            model,
            vendor,
            product,
            firmware,
            protocol,
            serial,
            min_range_mm,
            max_range_mm,
            steps_per_revolution,
            first_step,
            last_step,
            front_step,
            revolutions_per_minute: rpm,
        })
    }
}

/// The numbers that measuring needs.
fn needed(geometry: [Option<u32>; 5]) -> Result<[u32; 5], InfoError> {
    let mut numbers = [0; 5];
    for ((to, from), key) in numbers.iter_mut().zip(geometry).zip(NUMBER_KEYS.into_iter().skip(2)) {
        *to = from.ok_or(InfoError::Missing { key })?;
    }
    Ok(numbers)
}

fn saturated(number: u32) -> u16 {
    u16::try_from(number).unwrap_or(u16::MAX)
}

fn slot<'a, T>(keys: &[&str], slots: &'a mut [T], key: &str) -> Option<&'a mut T> {
    let index = keys.iter().position(|k| *k == key)?;
    slots.get_mut(index)
}

#[cfg(feature = "slam-core")]
impl From<&SensorInfo> for slam_core::sensor::scan::ScanGeometry {
    fn from(info: &SensorInfo) -> Self {
        Self {
            first_step: info.first_step,
            last_step: info.last_step,
            front_step: info.front_step,
            steps_per_revolution: info.steps_per_revolution.into(),
            revolution_us: info.revolution_us(),
        }
    }
}

#[cfg(feature = "slam-core")]
impl From<&SensorInfo> for slam_core::sensor::scan::RangeCodes {
    /// Codes 0 and 6 mean "nothing in range" on this family of sensors.
    fn from(info: &SensorInfo) -> Self {
        Self { min_mm: info.min_range_mm, max_mm: info.max_range_mm, ..Self::URG_04LX }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PP: [(&str, &str); 8] = [
        ("MODL", "URG-04LX(Hokuyo Automatic Co.,Ltd.)"),
        ("DMIN", "20"),
        ("DMAX", "5600"),
        ("ARES", "1024"),
        ("AMIN", "44"),
        ("AMAX", "725"),
        ("AFRT", "384"),
        ("SCAN", "600"),
    ];

    fn built(change: (&str, Option<&str>)) -> Result<SensorInfo, InfoError> {
        let mut builder = InfoBuilder::default();
        for (key, value) in PP {
            let value = if key == change.0 { change.1 } else { Some(value) };
            if let Some(value) = value {
                builder.take(Field { key, value });
            }
        }
        builder.build()
    }

    #[test]
    fn the_urg_s_geometry_is_read() {
        let info = built(("", None)).unwrap();
        assert_eq!(info.beams(), 682);
        assert_eq!(info.revolution_us(), 100_000);
        // 44 at 4.3 ms, 384 at 37.5 ms, 725 at 70.8 ms.
        assert_eq!([44, 384, 725].map(|s| info.step_us(s)), [4_296, 37_500, 70_800]);
        assert_eq!(
            slam_core::sensor::scan::ScanGeometry::from(&info),
            slam_core::sensor::scan::ScanGeometry::URG_04LX
        );
        assert_eq!(
            slam_core::sensor::scan::RangeCodes::from(&info),
            slam_core::sensor::scan::RangeCodes::URG_04LX
        );
    }

    #[test]
    fn what_is_missing_or_impossible_is_named() {
        for key in &NUMBER_KEYS[2..] {
            assert_eq!(built((key, None)), Err(InfoError::Missing { key }));
            assert_eq!(built((key, Some("1x"))), Err(InfoError::Missing { key }));
            assert_eq!(built((key, Some("4294967296"))), Err(InfoError::Missing { key }));
        }
        for (key, value) in [
            ("DMIN", 65_535),
            ("DMAX", 20),
            ("ARES", 0),
            ("ARES", 65_536),
            ("AMIN", 726),
            ("AMAX", 10_000),
            ("AMAX", 65_536 + 725),
            ("AFRT", 43),
            ("AFRT", 726),
            ("SCAN", 0),
            ("SCAN", 65_536),
        ] {
            let text = std::string::ToString::to_string(&value);
            assert_eq!(built((key, Some(&text))), Err(InfoError::Impossible { key, value }));
        }
    }

    #[test]
    fn what_measuring_does_not_need_may_be_missing_or_too_large() {
        for missing in [None, Some("?")] {
            assert_eq!(built(("MODL", missing)).unwrap().beams(), 682);
            assert_eq!(built(("DMIN", missing)).unwrap().min_range_mm, 20);
            assert_eq!(built(("DMAX", missing)).unwrap().max_range_mm, 65_535);
        }
        assert_eq!(built(("DMAX", Some("100000"))).unwrap().max_range_mm, 65_535);
        assert_eq!(built(("DMAX", Some("30000"))).unwrap().max_range_mm, 30_000);
    }

    #[test]
    fn long_texts_are_cut() {
        let mut builder = InfoBuilder::default();
        for (key, value) in PP {
            builder.take(Field { key, value });
        }
        builder.take(Field { key: "VEND", value: &"x".repeat(100) });
        assert_eq!(builder.build().unwrap().vendor.len(), TEXT);
    }
}
