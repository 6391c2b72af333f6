//! A URG-04LX, beam by beam, each at its own instant.

use nalgebra::{Isometry2, Point2, Vector2};
use rand::RngExt;
use rand_pcg::Pcg64;
use slam_core::sensor::scan::ScanGeometry;

pub use super::rays::{Hit, cast, distance_to};

use super::bias::Bias;
use super::config::{NEVER_M, SensorModel, SimConfig};
use super::rays::{meet_disc, meet_edge};
use super::streams::{Stream, gauss, stream};
use super::surfaces::{self, RoundSurface, Surface};
use super::tilt::{Floor, Tilt};
use super::world::{Disc, Finish, Sill, World};
use crate::robot::Robot;

/// Farthest distance the sensor reports, metres.
pub const REACH_M: f64 = 5.6;
/// Codes of the sensor for readings that went wrong: weak return, neighbours in error, two waves differ, not measurable.
const ERROR_CODES: [u16; 4] = [1, 7, 8, 19];
/// Neighbouring ranges farther apart than this have an edge between them, metres.
const EDGE_M: f64 = 0.1;

/// The code of a reading whose neighbours are in error.
const EDGE_CODE: u16 = 7;
/// Scatter of the reach on ordinary surfaces, which are not all alike.
const FADE_SIGMA: f64 = 0.2;
/// Glass is seen where the cosine between beam and normal is above this: 4°.
const GLASS_SEEN: f64 = 0.9976;
/// Shiny surfaces may be seen so much less flat than others.
const SHINY: f64 = 3.0;
/// Through windows there is so much more speckle.
const WINDOW_SPECKLE: f64 = 10.0;
/// Accuracy of a scanner whose profile states none: a URG-04LX's.
const USUAL_ACCURACY: [f64; 2] = [0.01, 0.01];

/// The simulated scanner.
pub struct Scanner {
    model: SensorModel,
    geometry: ScanGeometry,
    base_from_laser: Isometry2<f64>,
    surfaces: Vec<Surface>,
    round: Vec<RoundSurface>,
    sills: Vec<Sill>,
    bias: Bias,
    rng: Pcg64,
    speckle: Pcg64,
    weak: Pcg64,
}

/// What a beam met, and what that is like.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Met {
    hit: Hit,
    finish: Finish,
}

/// What a beam met on its way.
#[derive(Clone, Copy, Debug, Default)]
struct Seen {
    met: Option<Met>,
    through_glass: bool,
}

/// The instant of a scan.
#[derive(Clone, Copy, Debug, Default)]
pub struct Moment {
    /// Time since power-up, seconds.
    pub time_s: f64,
    /// Whether the robot is in somebody's hands.
    pub carried: bool,
}

impl Scanner {
    /// A robot's scanner in a world. The seed decides its bias and all its noise.
    pub fn new(world: &World, robot: &Robot, sim: &SimConfig, seed: u64) -> Self {
        let sensor = robot.config().sensor;
        Self {
            model: sim.sensor,
            geometry: sensor.geometry,
            base_from_laser: nalgebra::convert(sensor.mounting.base_from_laser),
            surfaces: surfaces::as_built(world, &sim.wall, seed),
            round: surfaces::round(world),
            sills: world.sills.clone(),
            bias: Bias::new(&sim.sensor, robot.sensor.accuracy.unwrap_or(USUAL_ACCURACY), seed),
            rng: stream(seed, Stream::Scanner),
            speckle: stream(seed, Stream::Speckle),
            weak: stream(seed, Stream::Weak),
        }
    }

    /// The factor that fits best between true ranges and this unit's.
    pub fn range_scale(&self) -> f64 {
        self.bias.range_scale(REACH_M)
    }

    /// One scan. `world_from_base` gives the robot's pose at a beam, `people` those who walk, at the middle beam.
    pub fn scan(
        &mut self,
        world_from_base: impl Fn(usize) -> Isometry2<f64>,
        people: &[Disc],
        moment: Moment,
    ) -> Vec<u16> {
        let beams = self.geometry.beams();
        let base = world_from_base(beams / 2);
        let middle = Point2::from((base * self.base_from_laser).translation.vector);
        // What no beam can reach is left out beforehand.
        let near_edge = |s: &&Surface| distance_to(&s.edge, middle) < REACH_M + 0.5;
        let near_disc = |s: &RoundSurface| (s.disc.centre - middle).norm() < REACH_M + 0.5 + s.disc.radius;
        let surfaces: Vec<Surface> = self.surfaces.iter().filter(near_edge).copied().collect();
        let people = people.iter().map(|disc| RoundSurface { disc: *disc, finish: Finish::Plain });
        let round: Vec<RoundSurface> = self.round.iter().copied().chain(people).filter(near_disc).collect();
        let level = moment.carried || self.model.tilt == 0.0 || !Tilt::possible(&self.sills, &base);
        let seen: Vec<Seen> = (0..beams)
            .map(|beam| {
                let base = world_from_base(beam);
                let pose = base * self.base_from_laser;
                let bearing = f64::from(self.geometry.bearing(beam));
                let direction = pose.rotation * Vector2::new(libm::cos(bearing), libm::sin(bearing));
                let seen = self.look(pose.translation.vector.into(), direction, &surfaces, &round);
                let tilt = match (moment.carried, level) {
                    (true, _) => Tilt::CARRIED,
                    (false, true) => return seen,
                    (false, false) => Tilt::on(&self.sills, &base).times(self.model.tilt),
                };
                let in_base = base.rotation.inverse() * direction;
                seen.with_floor(tilt.floor_m(self.model.height_m, &in_base))
            })
            .collect();
        (0..beams).map(|beam| self.reading(&seen, beam, moment.time_s)).collect()
    }

    /// What a ray meets. Glass that a real beam passes is left behind.
    fn look(
        &self,
        from: Point2<f64>,
        direction: Vector2<f64>,
        surfaces: &[Surface],
        round: &[RoundSurface],
    ) -> Seen {
        let transparent = self.model.glass_through > 0.5;
        let (mut best, mut pane): (Option<Met>, Option<f64>) = (None, None);
        let mut offer = |range_m: f64, incidence: f64, finish: Finish| {
            if range_m <= 1e-3 {
                return;
            }
            let glass = finish == Finish::Glass;
            if glass && transparent && incidence < GLASS_SEEN {
                pane = Some(pane.map_or(range_m, |pane| pane.min(range_m)));
            } else if best.is_none_or(|best| range_m < best.hit.range_m) {
                best = Some(Met { hit: Hit { range_m, incidence, glass: glass && !transparent }, finish });
            }
        };
        for surface in surfaces {
            if let Some((range_m, incidence)) = meet_edge(from, direction, &surface.edge) {
                offer(range_m, incidence, surface.finish);
            }
        }
        for surface in round {
            if let Some((range_m, incidence)) = meet_disc(from, direction, &surface.disc) {
                offer(range_m, incidence, surface.finish);
            }
        }
        let through_glass = pane.is_some_and(|pane| best.is_none_or(|best| pane < best.hit.range_m));
        Seen { met: best, through_glass }
    }

    fn reading(&mut self, seen: &[Seen], beam: usize, time_s: f64) -> u16 {
        // Drawn for every beam, so that a change of one model does not move the noise of the others.
        let noise: f64 = gauss(&mut self.rng);
        let uniform: f64 = self.rng.random_range(-1.0..1.0);
        let (lost, mixed, share): (f64, f64, f64) = (self.rng.random(), self.rng.random(), self.rng.random());
        let code = ERROR_CODES[self.rng.random_range(0..ERROR_CODES.len())];
        let (speckle, nonsense): (f64, f64) = (self.speckle.random(), self.speckle.random());
        let window = if seen[beam].through_glass { WINDOW_SPECKLE } else { 1.0 };
        if speckle < self.model.speckle * window {
            return in_mm(nonsense * REACH_M);
        }
        let Some(met) = seen[beam].met.filter(|met| !met.hit.glass) else { return 0 };
        if lost < self.model.dropout {
            return code;
        }
        let hit = met.hit;
        if let Some(code) = self.weak(seen, beam, &met) {
            return code;
        }
        // A surface almost along the beam returns too little.
        let flattest = if met.finish == Finish::Shiny { SHINY } else { 1.0 } * self.model.least_incidence;
        if hit.incidence < flattest {
            return code;
        }
        let mut range_m = hit.range_m;
        if mixed < self.model.mixed_pixels
            && let Some(next) = seen.get(beam + 1).and_then(|seen| seen.met)
            && (next.hit.range_m - hit.range_m).abs() > EDGE_M
            && !next.hit.glass
        {
            range_m += share * (next.hit.range_m - hit.range_m);
        }
        let sigma_m = self.model.sigma_m.max(self.model.sigma_per_m * range_m);
        let bias_m = self.bias.at(range_m, hit.incidence, met.finish, time_s);
        range_m += sigma_m * noise + self.model.uniform_m * uniform;
        range_m += bias_m;
        if range_m > REACH_M {
            return 0;
        }
        in_mm(range_m)
    }
}

impl Scanner {
    /// What is read where too little light comes back, or that of two surfaces.
    fn weak(&mut self, seen: &[Seen], beam: usize, met: &Met) -> Option<u16> {
        let (reach, edge, code) =
            (gauss(&mut self.weak), self.weak.random::<f64>(), self.weak.random::<f64>());
        let Hit { range_m, incidence, .. } = met.hit;
        let reach_m = match met.finish {
            Finish::Dark => self.model.dark_reach_m,
            _ if self.model.fade_m >= NEVER_M => f64::INFINITY,
            // Light that comes back goes with cosine and inverse square.
            _ => self.model.fade_m * incidence.sqrt() * (1.0 + FADE_SIGMA * reach),
        };
        if range_m > reach_m {
            return Some(0);
        }
        let apart = |other: Option<&Seen>| {
            let other_m = other.and_then(|seen| seen.met).map_or(f64::INFINITY, |met| met.hit.range_m);
            (other_m - range_m).abs() > EDGE_M
        };
        let at_edge = apart(beam.checked_sub(1).and_then(|k| seen.get(k))) || apart(seen.get(beam + 1));
        (at_edge && edge < self.model.edge_loss).then_some(if code < 0.5 { 0 } else { EDGE_CODE })
    }
}

impl Seen {
    /// What is seen where the floor, or nothing, comes first.
    fn with_floor(self, floor: Floor) -> Self {
        match floor {
            Floor::Beyond => self,
            Floor::Over => Self { met: None, through_glass: false },
            Floor::At(range_m) if self.met.is_none_or(|met| range_m < met.hit.range_m) => {
                let hit = Hit { range_m, incidence: 1.0, glass: false };
                Self { met: Some(Met { hit, finish: Finish::Plain }), through_glass: false }
            }
            Floor::At(_) => self,
        }
    }
}

fn in_mm(range_m: f64) -> u16 {
    (range_m * 1000.0).round().clamp(20.0, 5600.0) as u16
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sim::SimKind;

    /// Two hundred readings straight ahead of a robot before the things of a world.
    fn ahead(things: &str, sim: &SimConfig, heading_deg: f64) -> Vec<u16> {
        let text = format!(
            "name = \"t\"\n{things}\n[path]\nheading_deg = 0\nspeed = 0.3\npoints = [[0, 0], [1, 0]]\n"
        );
        let world: World = crate::toml_file::parse(&text, std::path::Path::new("t.toml")).unwrap();
        let robot = Robot::usual_for("simulated");
        let mut scanner = Scanner::new(&world, &robot, sim, 3);
        let pose = Isometry2::new(Vector2::zeros(), heading_deg.to_radians());
        (0..200).map(|_| scanner.scan(|_| pose, &[], Moment { time_s: 1e6, carried: false })[340]).collect()
    }

    fn median(mut readings: Vec<u16>) -> u16 {
        readings.sort_unstable();
        readings[readings.len() / 2]
    }

    /// A pane 2 m before the scanner, a wall behind it.
    const WINDOW: &str = "[[wall]]\nglass = true\npoints = [[2.14, -3], [2.14, 3]]\n[[wall]]\npoints = [[4.14, -5], [4.14, 5]]";

    #[test]
    fn glass_is_seen_through_except_at_right_angles() {
        let mut real = SimConfig::of(SimKind::Real);
        real.set("sensor.fade_m=1000").unwrap();
        let through = median(ahead(WINDOW, &real, 15.0));
        // The scanner sits 0.14 m ahead: 4.14 m less that, along the slant.
        let expected = 1000.0 * (4.14 - 0.14 * 15f64.to_radians().cos()) / 15f64.to_radians().cos();
        assert!((f64::from(through) - expected).abs() < 80.0, "{through} mm, not {expected}");
        let square = median(ahead(WINDOW, &real, 0.0));
        assert!((i32::from(square) - 2000).abs() < 60, "{square} mm");
        for heading_deg in [0.0, 15.0] {
            assert!(
                ahead(WINDOW, &SimConfig::default(), heading_deg).iter().all(|mm| *mm == 0),
                "ideal glass"
            );
        }
    }

    #[test]
    fn dark_surfaces_return_nothing_from_afar() {
        let wall = |x: f64| format!("[[wall]]\nfinish = \"dark\"\npoints = [[{x}, -3], [{x}, 3]]");
        let real = SimConfig::of(SimKind::Real);
        assert!((i32::from(median(ahead(&wall(1.94), &real, 0.0))) - 1800).abs() < 60);
        assert_eq!(median(ahead(&wall(2.44), &real, 0.0)), 0);
        assert!((i32::from(median(ahead(&wall(2.44), &SimConfig::default(), 0.0))) - 2300).abs() < 60);
    }

    #[test]
    fn returns_fade_with_range_and_slant_and_at_edges() {
        let mut sim = SimConfig::default();
        sim.set("sensor.fade_m=4.5").unwrap();
        let wall = |x: f64| format!("[[wall]]\npoints = [[{x}, -9], [{x}, 9]]");
        let none = |things: &str, sim: &SimConfig, deg| {
            ahead(things, sim, deg).iter().filter(|mm| **mm == 0).count()
        };
        let [near, far] = [2.14, 4.64].map(|x| none(&wall(x), &sim, 0.0));
        assert!(near < 10 && (60..140).contains(&far), "{near} and {far} of 200");
        let slanted = none(&wall(2.14), &sim, 60.0);
        assert!(slanted > 120, "{slanted} of 200 at 4 m and 60°");
        // A leg as wide as one beam.
        sim = SimConfig::default();
        sim.set("sensor.edge_loss=0.6").unwrap();
        let leg = "[[pillar]]\ncentre = [2.14, 0]\nradius = 0.008";
        let lost = ahead(leg, &sim, 0.0).iter().filter(|mm| **mm <= 20).count();
        assert!((100..145).contains(&lost), "{lost} of 200");
    }

    #[test]
    fn sunlight_speckles_through_windows() {
        let mut sim = SimConfig::default();
        sim.set("sensor.speckle=0.02").unwrap();
        sim.set("sensor.glass_through=1").unwrap();
        let wall = "[[wall]]\npoints = [[4.14, -5], [4.14, 5]]";
        let odd = |things: &str| {
            let readings = ahead(things, &sim, 15.0);
            readings.iter().filter(|mm| **mm > 20 && (i32::from(**mm) - 4145).abs() > 300).count()
        };
        let (plain, window) = (odd(wall), odd(WINDOW));
        assert!(plain < 15 && (20..70).contains(&window), "{plain} and {window} of 200");
    }

    #[test]
    fn beams_hit_the_floor_on_a_sill() {
        let sill = |x: f64| {
            format!(
                "[[wall]]\npoints = [[5.14, -5], [5.14, 5]]\n[[sill]]\nfrom = [{x}, -1]\nto = [{x}, 1]\nheight = 0.015"
            )
        };
        let mut real = SimConfig::of(SimKind::Real);
        real.set("sensor.fade_m=1000").unwrap();
        // The caster, 0.15 m behind the axle, is on it: the nose points down by 0.1, the floor is 2 m off.
        let floor = median(ahead(&sill(-0.15), &real, 0.0));
        assert!((1900..2100).contains(&floor), "{floor} mm");
        for level in [ahead(&sill(-0.6), &real, 0.0), ahead(&sill(-0.15), &SimConfig::default(), 0.0)] {
            let wall = median(level);
            assert!((4850..5150).contains(&wall), "{wall} mm");
        }
    }
}
