//! Absolute trajectory error after one SE(2) alignment: how a trajectory is judged against a reference.

use nalgebra::Vector2;

/// A stamped planar position, seconds and metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StampedPosition {
    /// Stamp, seconds.
    pub stamp_s: f64,
    /// Position, metres.
    pub position: Vector2<f64>,
}

/// A trajectory file that is not one: the line, from 1.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("line {line} is not a TUM pose (timestamp x y z qx qy qz qw)")]
pub struct NotTum {
    /// Line, from 1.
    pub line: usize,
}

/// Reads the positions of a TUM trajectory.
pub fn parse_tum(text: &str) -> Result<Vec<StampedPosition>, NotTum> {
    let mut poses = Vec::new();
    for (index, line) in text.lines().enumerate() {
        if line.trim().is_empty() || line.starts_with('#') {
            continue;
        }
        let numbers: Vec<f64> = line.split_whitespace().filter_map(|w| w.parse().ok()).collect();
        let [stamp_s, x, y, _, _, _, _, _] = numbers[..] else { return Err(NotTum { line: index + 1 }) };
        poses.push(StampedPosition { stamp_s, position: Vector2::new(x, y) });
    }
    Ok(poses)
}

/// Root mean square distance, metres, between an estimate and a reference with the same stamps (to 2 ms), after the
/// rotation and translation that lay the estimate on the reference best. Reference poses without an estimate are scored
/// as standing still since the last one. `None` when nothing agrees.
pub fn absolute_trajectory_error(estimate: &[StampedPosition], reference: &[StampedPosition]) -> Option<f64> {
    let mut pairs: Vec<(Vector2<f64>, Vector2<f64>)> = Vec::new();
    let mut rest = estimate.iter().peekable();
    let mut last = None;
    for truth in reference {
        while let Some(e) = rest.next_if(|e| e.stamp_s <= truth.stamp_s + 2e-3) {
            last = Some(e.position);
        }
        if let Some(position) = last {
            pairs.push((position, truth.position));
        }
    }
    if pairs.is_empty() {
        return None;
    }
    let n = pairs.len() as f64;
    let mean_e = pairs.iter().map(|p| p.0).sum::<Vector2<f64>>() / n;
    let mean_r = pairs.iter().map(|p| p.1).sum::<Vector2<f64>>() / n;
    let (mut cos, mut sin) = (0.0, 0.0);
    for (e, r) in &pairs {
        let (e, r) = (e - mean_e, r - mean_r);
        cos += e.dot(&r);
        sin += e.x * r.y - e.y * r.x;
    }
    let (s, c) = sin.atan2(cos).sin_cos();
    let square = |(e, r): &(Vector2<f64>, Vector2<f64>)| {
        let e = e - mean_e;
        let aligned = Vector2::new(c * e.x - s * e.y, s * e.x + c * e.y);
        (aligned - (r - mean_r)).norm_squared()
    };
    Some((pairs.iter().map(square).sum::<f64>() / n).sqrt())
}
