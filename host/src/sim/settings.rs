//! Errors of the simulated robot from the command line, and which no robot can have.

use super::config::{SimConfig, SimKind};

/// A setting that cannot be made.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("--set {setting}: {reason}")]
pub struct BadSetting {
    /// As given.
    pub setting: String,
    /// What is wrong with it.
    pub reason: String,
}

impl SimConfig {
    /// Changes one value, given as `wheel.radius_error=0.01`, or all of them, given as `kind=real`.
    pub fn set(&mut self, setting: &str) -> Result<(), BadSetting> {
        let bad = |reason: String| BadSetting { setting: setting.to_owned(), reason };
        let (key, value) = setting.split_once('=').ok_or_else(|| bad("expected key=value".into()))?;
        if key == "kind" {
            let kind = SimKind::ALL.into_iter().find(|kind| kind.name() == value);
            *self = Self::of(kind.ok_or_else(|| bad(format!("'{value}' is neither ideal nor real")))?);
            return Ok(());
        }
        let value: toml::Value = match value.parse::<f64>() {
            Ok(number) if number.is_finite() && number.fract() == 0.0 && key.ends_with("every") => {
                toml::Value::Integer(number as i64)
            }
            Ok(number) if number.is_finite() => toml::Value::Float(number),
            _ => return Err(bad(format!("'{value}' is not a number"))),
        };
        let mut all = toml::Table::try_from(*self).map_err(|e| bad(e.to_string()))?;
        let unknown = || bad(format!("there is no key '{key}'"));
        let (table, name) = key.split_once('.').ok_or_else(unknown)?;
        let slot = all.get_mut(table).and_then(toml::Value::as_table_mut).and_then(|t| t.get_mut(name));
        *slot.ok_or_else(unknown)? = value;
        let changed: Self = all.try_into().map_err(|e| bad(e.to_string()))?;
        changed.check().map_err(bad)?;
        *self = changed;
        Ok(())
    }

    /// Says which value no robot can have.
    fn check(&self) -> Result<(), String> {
        let within = |name: &str, value: f64, least: f64, most: f64| {
            if (least..=most).contains(&value) {
                Ok(())
            } else if least == 0.0 && most == f64::INFINITY {
                Err(format!("{name} is below zero"))
            } else {
                Err(format!("{name} is not within {least} to {most}"))
            }
        };
        let Self { wheel: w, sensor: s, clock: c, wall, fault: f, .. } = self;
        let small = [
            ("wheel.radius_error", w.radius_error),
            ("wheel.radius_difference", w.radius_difference),
            ("wheel.track_error", w.track_error),
        ];
        small.into_iter().try_for_each(|(name, value)| within(name, value, -0.499, 0.499))?;
        let shares = [
            ("wheel.start_slip_share", w.start_slip_share),
            ("sensor.dropout", s.dropout),
            ("sensor.mixed_pixels", s.mixed_pixels),
            ("sensor.least_incidence", s.least_incidence),
            ("sensor.edge_loss", s.edge_loss),
            ("sensor.glass_through", s.glass_through),
            ("sensor.speckle", s.speckle),
            ("clock.hiccups", c.hiccups),
        ];
        shares.into_iter().try_for_each(|(name, value)| within(name, value, 0.0, 1.0))?;
        let not_negative = [
            ("wheel.slip_m_per_sqrt_m", w.slip_m_per_sqrt_m),
            ("wheel.turn_slip", w.turn_slip),
            ("wheel.start_slip_deg", w.start_slip_deg),
            ("wheel.spins_per_min", w.spins_per_min),
            ("wheel.spin_m", w.spin_m),
            ("wheel.caster_kick_deg", w.caster_kick_deg),
            ("sensor.sigma_m", s.sigma_m),
            ("sensor.sigma_per_m", s.sigma_per_m),
            ("sensor.uniform_m", s.uniform_m),
            ("sensor.delay_s", s.delay_s),
            ("sensor.bias", s.bias),
            ("sensor.warm_up_m", s.warm_up_m),
            ("sensor.fade_m", s.fade_m),
            ("sensor.dark_reach_m", s.dark_reach_m),
            ("sensor.tilt", s.tilt),
            ("clock.jitter_s", c.jitter_s),
            ("fault.spin_left_at_s", f.spin_left_at_s),
            ("fault.spin_right_at_s", f.spin_right_at_s),
            ("fault.spin_s", f.spin_s),
            ("fault.lift_at_s", f.lift_at_s),
            ("fault.restart_at_s", f.restart_at_s),
            ("fault.swap_at_s", f.swap_at_s),
            ("fault.reverse_left_at_s", f.reverse_left_at_s),
            ("fault.reverse_right_at_s", f.reverse_right_at_s),
            ("fault.dead_left_at_s", f.dead_left_at_s),
            ("fault.dead_right_at_s", f.dead_right_at_s),
        ];
        not_negative.into_iter().try_for_each(|(name, value)| within(name, value, 0.0, f64::INFINITY))?;
        within("sensor.warm_up_s", s.warm_up_s, 1.0, 1e6)?;
        within("sensor.height_m", s.height_m, 0.02, 2.0)?;
        within("clock.revolution", c.revolution, 0.0, 0.1)?;
        within("clock.offset_s", c.offset_s, 0.0, 1.0)?;
        within("wall.bow_m", wall.bow_m, 0.0, 0.1)?;
        within("wall.skirting_m", wall.skirting_m, 0.0, 0.1)?;
        within("fault.lift_s", f.lift_s, 0.1, 60.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_default_is_the_ideal_kind_and_settings_go_before_the_kind() {
        assert_eq!(SimConfig::default(), SimConfig::of(SimKind::Ideal));
        let mut config = SimConfig::default();
        for setting in ["kind=real", "sensor.bias=0.5", "fault.restart_at_s=12"] {
            config.set(setting).unwrap();
        }
        let mut expected = SimConfig::of(SimKind::Real);
        expected.sensor.bias = 0.5;
        expected.fault.restart_at_s = 12.0;
        assert_eq!(config, expected);
        assert!(config.set("kind=unreal").unwrap_err().to_string().contains("neither ideal nor real"));
        assert!(config.set("wall.bow_m=3").unwrap_err().to_string().contains("wall.bow_m is not within"));
    }
}
