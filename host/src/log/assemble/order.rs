//! Which of some stamps are in order.

/// Which stamps to keep so that none is below the one before, nor below zero; equal ones are kept where they stand together.
pub(super) fn not_decreasing(stamps: &[i64]) -> Vec<bool> {
    in_order(stamps, true, |longest, greedy| longest as f64 > 1.1 * greedy as f64)
}

/// The same, strictly.
pub(super) fn increasing(stamps: &[i64]) -> Vec<bool> {
    in_order(stamps, false, |longest, greedy| longest > greedy + 1)
}

/// Which stamps to keep: each that follows the last one kept; but where a stamp far ahead would leave out what comes after it,
/// as many as can be kept, if those are so many more.
fn in_order(stamps: &[i64], equal: bool, many_more: impl Fn(usize, usize) -> bool) -> Vec<bool> {
    let mut last = None;
    let mut greedy = Vec::with_capacity(stamps.len());
    for &stamp in stamps {
        let together = equal && greedy.last() == Some(&true);
        let kept = stamp >= 0 && last.is_none_or(|last| stamp > last || (together && stamp == last));
        if kept {
            last = Some(stamp);
        }
        greedy.push(kept);
    }
    let longest = longest_in_order(stamps, |last, now| now > last || (equal && now == last));
    let count = |kept: &[bool]| kept.iter().filter(|kept| **kept).count();
    if many_more(count(&longest), count(&greedy)) { longest } else { greedy }
}

/// The longest sequence of stamps in order, by patience sorting.
fn longest_in_order(stamps: &[i64], follows: impl Fn(i64, i64) -> bool) -> Vec<bool> {
    // By length: the index of the least last stamp; and for each stamp the index of the one before it.
    let mut ends: Vec<usize> = Vec::new();
    let mut before: Vec<Option<usize>> = vec![None; stamps.len()];
    for (k, &stamp) in stamps.iter().enumerate().filter(|(_, stamp)| **stamp >= 0) {
        let length = ends.partition_point(|end| follows(stamps[*end], stamp));
        before[k] = length.checked_sub(1).map(|l| ends[l]);
        if length == ends.len() {
            ends.push(k);
        } else {
            ends[length] = k;
        }
    }
    let mut kept = vec![false; stamps.len()];
    let mut at = ends.last().copied();
    while let Some(k) = at {
        kept[k] = true;
        at = before[k];
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;

    fn kept(stamps: &[i64]) -> Vec<i64> {
        stamps.iter().zip(increasing(stamps)).filter_map(|(s, kept)| kept.then_some(*s)).collect()
    }

    #[test]
    fn equal_stamps_are_kept_where_they_stand_together() {
        let stamps: Vec<i64> = (0..20).flat_map(|k| [k, k]).chain([0, 19]).collect();
        let kept = not_decreasing(&stamps);
        assert!(kept[..40].iter().all(|kept| *kept) && kept[40..] == [false, false], "{kept:?}");
    }

    #[test]
    fn stamps_from_the_past_are_left_out_and_one_from_the_future_does_not_leave_out_the_rest() {
        assert_eq!(kept(&[1, 2, 0, 3, 3, -5, 4]), [1, 2, 3, 4]);
        assert_eq!(kept(&[1, 2, 900, 3, 4, 5, 6]), [1, 2, 3, 4, 5, 6]);
        assert_eq!(kept(&[1, 2, 3, 4, 1, 2, 3, 4]), [1, 2, 3, 4]);
        assert_eq!(kept(&[]), [0i64; 0]);
    }
}
