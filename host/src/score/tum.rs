//! TUM trajectories: `timestamp x y z qx qy qz qw` a line, `#` begins a comment.

use nalgebra::{Isometry2, Vector2};

use super::{StampedPose, content, numbers};

/// A trajectory file that is not one: the line, from 1.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("line {line} is not a TUM pose (timestamp x y z qx qy qz qw)")]
pub struct NotTum {
    /// Line, from 1.
    pub line: usize,
}

/// Reads a TUM trajectory, of each orientation the turn about the vertical, and sorts it by time.
pub fn parse_tum(text: &str) -> Result<Vec<StampedPose>, NotTum> {
    let mut poses = Vec::new();
    for (index, line) in text.lines().enumerate() {
        let Some(line) = content(line) else { continue };
        let Some(&[stamp_s, x, y, _, qx, qy, qz, qw]) = numbers(line).as_deref() else {
            return Err(NotTum { line: index + 1 });
        };
        let (sin, cos) = (2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz));
        poses.push(StampedPose { stamp_s, pose: Isometry2::new(Vector2::new(x, y), f64::atan2(sin, cos)) });
    }
    poses.sort_by(|a, b| a.stamp_s.total_cmp(&b.stamp_s));
    Ok(poses)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_trajectory_file_is_read_with_its_headings() {
        let text = "# stamp x y z qx qy qz qw\n\n1.5 2 -3 0 0 0 0.6 0.8\n0.5 0 0 0 0 0 0 1 # first\n";
        let heading = 2.0 * 0.6_f64.atan2(0.8);
        let want = Isometry2::new(Vector2::new(2.0, -3.0), heading);
        let [first, second] = parse_tum(text).unwrap()[..] else { panic!("two poses") };
        assert_eq!((first.stamp_s, second.stamp_s), (0.5, 1.5), "sorted by time");
        assert!(second.pose.inv_mul(&want).to_homogeneous().is_identity(1e-12), "{second:?}");
    }

    #[test]
    fn a_line_that_is_no_pose_is_named() {
        let good = "1 2 3 4 0 0 0 1\n";
        for bad in ["1 2 3", "1 2 3 4 0 0 0 1 9", "1 2 x 4 0 0 0 1", "1 2 NaN 4 0 0 0 1", "1 2 inf 4 0 0 0 1"]
        {
            assert_eq!(parse_tum(&format!("{good}\n{bad}\n")), Err(NotTum { line: 3 }), "{bad}");
        }
        assert_eq!(parse_tum(""), Ok(Vec::new()));
    }
}
