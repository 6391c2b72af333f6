//! Lists of a few dozen items: in order, or the best of many.

use heapless::Vec;

/// Sorts a few dozen items, least key first; those of the same key stay in their order. By insertion: the standard library's sort is 4 kB of
/// flash for each kind of item.
///
/// Work: half the square of their number, where they are in no order.
pub fn sort_few<T>(items: &mut [T], key: impl Fn(&T) -> f32) {
    for end in 1..items.len() {
        for at in (1..=end).rev() {
            match items.get(at - 1..=at) {
                Some([before, own]) if key(own) < key(before) => items.swap(at - 1, at),
                _ => break,
            }
        }
    }
}

/// Adds an item to a list of those that are worth most; a full one gives up the one that is worth least.
///
/// Work: a step for each item of a full list.
pub fn keep_most<T, const N: usize>(items: &mut Vec<T, N>, new: T, worth: impl Fn(&T) -> f32) {
    if let Err(new) = items.push(new)
        && let Some(least) = items.iter_mut().min_by(|a, b| worth(a).total_cmp(&worth(b)))
        && worth(least) < worth(&new)
    {
        *least = new;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_few_are_sorted_and_equals_stay_in_order() {
        let mut items = [(3.0, 'a'), (-1.0, 'b'), (3.0, 'c'), (f32::INFINITY, 'd'), (0.5, 'e'), (-1.0, 'f')];
        sort_few(&mut items, |item| item.0);
        assert_eq!(items.map(|item| item.1), ['b', 'f', 'e', 'a', 'c', 'd']);
        sort_few(&mut [0.0f32; 0], |item| *item);
    }

    #[test]
    fn a_full_list_keeps_what_is_worth_most() {
        let mut items: Vec<f32, 3> = Vec::new();
        for new in [1.0, 5.0, 3.0, 2.0, 0.5, 4.0] {
            keep_most(&mut items, new, |item| *item);
        }
        assert_eq!(items, [4.0, 5.0, 3.0]);
        keep_most(&mut Vec::<f32, 0>::new(), 1.0, |item| *item);
    }
}
