//! A path in bounded memory.

/// Points are no nearer together than this, metres, at first.
const APART_M: f32 = 0.05;
/// With more points than this every other one goes, and they are twice as far apart from then on.
const MOST_POINTS: usize = 10_000;

/// Where a robot has been, the coarser the longer it drives.
#[derive(Clone, Debug)]
pub struct Trail {
    points: Vec<[f32; 2]>,
    apart_m: f32,
}

impl Default for Trail {
    fn default() -> Self {
        Self { points: Vec::new(), apart_m: APART_M }
    }
}

impl Trail {
    /// Adds a point (m), unless it is at the last one.
    pub fn push(&mut self, [x, y]: [f32; 2]) {
        if self.points.last().is_some_and(|last| (last[0] - x).hypot(last[1] - y) < self.apart_m) {
            return;
        }
        self.points.push([x, y]);
        if self.points.len() > MOST_POINTS {
            let mut number = 0usize;
            self.points.retain(|_| {
                number += 1;
                number % 2 == 1
            });
            self.apart_m *= 2.0;
        }
    }

    /// Begins anew with these.
    pub fn replace(&mut self, points: impl Iterator<Item = [f32; 2]>) {
        *self = Self::default();
        points.for_each(|point| self.push(point));
    }

    /// x and y of each point, metres.
    pub fn points(&self) -> &[[f32; 2]] {
        &self.points
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_path_is_thinned_and_keeps_its_ends() {
        let mut trail = Trail::default();
        for step in 0..100_000 {
            trail.push([step as f32 * 0.06, 2.0]);
            assert!(trail.points().len() <= MOST_POINTS);
        }
        assert!(trail.points().len() > MOST_POINTS / 4);
        assert_eq!(trail.points()[0], [0.0, 2.0]);
        assert!((trail.points().last().unwrap()[0] - 6000.0).abs() < 2.0);
    }

    #[test]
    fn a_robot_that_stands_adds_nothing() {
        let mut trail = Trail::default();
        (0..10).for_each(|_| trail.push([1.0, 1.0]));
        assert_eq!(trail.points().len(), 1);
        trail.replace([[0.0, 0.0], [1.0, 0.0]].into_iter());
        assert_eq!(trail.points(), [[0.0, 0.0], [1.0, 0.0]]);
    }
}
