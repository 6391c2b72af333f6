//! The bias of one scanner: by range, incidence and surface, within its data sheet, and while it is cold.
//!
//! Kneip et al. (ICRA 2009) find the URG-04LX's error to depend on distance, on colour, brightness and material of the target, on
//! the incidence angle, and on the time since power-up, and so much on the target that no calibration takes it away.

use rand::RngExt;

use super::config::SensorModel;
use super::streams::{Stream, stream};
use super::world::Finish;

/// Shares of the data sheet's accuracy: an offset, a scale, a wave over the range, the incidence. They add up to 1.
const SHARES: [f64; 4] = [0.15, 0.5, 0.15, 0.2];
/// Length of the wave, metres: a few modulation periods of a phase meter over its reach.
const WAVE_M: f64 = 1.5;

/// What one unit's ranges are wrong by, apart from noise.
#[derive(Clone, Debug)]
pub struct Bias {
    /// Accuracy by the data sheet that the unit uses up: metres, and as a share of the range.
    accuracy: [f64; 2],
    /// Offset, scale, wave and incidence of this unit, ±1.
    drawn: [f64; 4],
    phase: f64,
    /// Of dark and of shiny surfaces, ±1.
    dark: f64,
    shiny: f64,
    /// When cold, metres, and time constant, seconds.
    warm_up: [f64; 2],
}

impl Bias {
    /// The bias that the seed draws for a unit whose data sheet states this accuracy (metres, and share of the range).
    pub fn new(model: &SensorModel, accuracy: [f64; 2], seed: u64) -> Self {
        let mut rng = stream(seed, Stream::Bias);
        let mut draw = || -> f64 { rng.random_range(-1.0..1.0) };
        let drawn = [draw(), draw(), draw(), draw()];
        let (phase, dark, shiny) = (draw() * std::f64::consts::PI, draw(), draw());
        let cold: f64 = stream(seed, Stream::WarmUp).random_range(-1.0..1.0);
        Self {
            accuracy: accuracy.map(|a| a * model.bias),
            drawn,
            phase,
            dark,
            shiny,
            warm_up: [cold * model.warm_up_m, model.warm_up_s],
        }
    }

    /// What a range is wrong by, metres. `incidence` is the cosine between beam and surface normal.
    pub fn at(&self, range_m: f64, incidence: f64, finish: Finish, time_s: f64) -> f64 {
        let allowed_m = self.accuracy[0].max(self.accuracy[1] * range_m);
        let [offset, scale, wave, slant] = [0, 1, 2, 3].map(|k| SHARES[k] * self.drawn[k]);
        let waved = libm::sin(2.0 * std::f64::consts::PI * range_m / WAVE_M + self.phase);
        let surface = match finish {
            Finish::Plain | Finish::Glass => 0.0,
            Finish::Dark => self.dark,
            Finish::Shiny => self.shiny,
        };
        let [cold_m, warm_s] = self.warm_up;
        offset * self.accuracy[0]
            + scale * self.accuracy[1] * range_m
            + (wave * waved + slant * (1.0 - incidence) + surface) * allowed_m
            + cold_m * libm::exp(-time_s / warm_s)
    }

    /// The factor that fits best between true ranges to plain walls, up to `reach_m`, and those that the warm unit shows.
    pub fn range_scale(&self, reach_m: f64) -> f64 {
        let ranges: Vec<f64> = (5..).map(|k| 0.1 * f64::from(k)).take_while(|r| *r <= reach_m).collect();
        let shown = |r: f64| r + self.at(r, 1.0, Finish::Plain, 1e9);
        let sum = |of: &dyn Fn(f64) -> f64| ranges.iter().map(|r| of(*r)).sum::<f64>();
        sum(&|r| r * shown(r)) / sum(&|r| r * r)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHEET: [f64; 2] = [0.01, 0.01];

    fn model(bias: f64, warm_up_m: f64) -> SensorModel {
        SensorModel { bias, warm_up_m, ..SensorModel::default() }
    }

    #[test]
    fn bias_stays_within_the_data_sheet_and_uses_it() {
        let mut worst = 0.0f64;
        for seed in 0..200 {
            let bias = Bias::new(&model(1.0, 0.0), SHEET, seed);
            for range_m in (1..56).map(|k| 0.1 * f64::from(k)) {
                let allowed_m = SHEET[0].max(SHEET[1] * range_m);
                for incidence in [1.0, 0.7, 0.2] {
                    let plain = bias.at(range_m, incidence, Finish::Plain, 0.0).abs() / allowed_m;
                    assert!(plain <= 1.0, "seed {seed}, {range_m} m: {plain} of the data sheet");
                    worst = worst.max(plain);
                    let dark = bias.at(range_m, incidence, Finish::Dark, 0.0).abs() / allowed_m;
                    assert!(dark <= 2.0);
                }
            }
        }
        assert!(worst > 0.6, "no unit uses more than {worst} of the data sheet");
    }

    #[test]
    fn dark_and_shiny_surfaces_are_worse_and_none_is_none() {
        let rms = |finish: Finish| {
            let of = |seed| Bias::new(&model(1.0, 0.0), SHEET, seed).at(3.0, 1.0, finish, 0.0).powi(2);
            ((0..200).map(of).sum::<f64>() / 200.0).sqrt()
        };
        assert!(
            rms(Finish::Dark) > 1.3 * rms(Finish::Plain) && rms(Finish::Shiny) > 1.3 * rms(Finish::Plain)
        );
        assert_eq!(Bias::new(&model(0.0, 0.0), SHEET, 3).at(3.0, 0.5, Finish::Dark, 0.0), 0.0);
    }

    #[test]
    fn a_unit_drifts_until_it_is_warm() {
        let bias = Bias::new(&model(0.0, 0.01), SHEET, 5);
        let at = |time_s| bias.at(2.0, 1.0, Finish::Plain, time_s).abs();
        assert!(at(0.0) > 1e-4 && at(0.0) <= 0.01);
        assert!((at(600.0) / at(0.0) - (-1f64).exp()).abs() < 1e-9);
        assert!(at(6000.0) < 1e-4 * 0.01 * 100.0);
    }

    #[test]
    fn the_scale_is_that_of_the_ranges() {
        let mut bias = Bias::new(&model(1.0, 0.0), SHEET, 1);
        bias.drawn = [0.0, 1.0, 0.0, 0.0];
        assert!((bias.range_scale(5.6) - 1.005).abs() < 1e-9);
    }
}
