use super::*;
use crate::ekf::state::POSE;
use crate::ekf::world::{INFLATION, World};

#[test]
fn a_line_activated_again_has_inflated_variances_and_no_correlations() {
    let mut world = World::new(7);
    world.look();
    let index = 3;
    let slot = world.filter.slot_of(index).unwrap();
    world.filter.decouple(slot, &mut world.map);
    let own = variances(&world.map.segments()[index].segment());
    let slot = world.filter.activate(index, INFLATION, &mut world.map).unwrap();
    for (state, own) in line_states(slot).into_iter().zip(own) {
        assert_eq!(world.filter.covariance.get(state, state), INFLATION * own);
        assert_eq!(world.filter.covariance.get(POSE, state), 0.0);
    }
    // One in the state stays as it is.
    assert_eq!(world.filter.activate(index, INFLATION, &mut world.map), Some(slot));
    assert_eq!(world.filter.covariance.get(line_states(slot)[0], line_states(slot)[0]), INFLATION * own[0]);
}

/// The map has dropped a segment for a new one, at the same index.
#[test]
fn a_new_segment_does_not_inherit_what_was_known_of_another() {
    let mut world = World::new(2);
    world.look();
    let known = world.filter.slots.lines();
    world.filter.line_replaced(0);
    world.filter.augment(0, Vector2::zeros(), &mut world.map);
    assert_eq!((0..LINES).filter(|slot| world.filter.line_id(*slot) == Some(0)).count(), 1);
    assert_eq!(world.filter.slots.lines(), known);
}

#[test]
fn a_segment_that_leaves_the_map_leaves_its_slot() {
    let mut world = World::new(2);
    world.look();
    let last = world.map.segments().len() - 1;
    world.map.forget(0);
    world.filter.line_removed(0, last);
    let lines = world.filter.slots.lines();
    assert_eq!(lines, last, "one slot is free, the last segment's is known by its new index");
    assert!(world.filter.slot_of(0).is_some() && world.filter.slot_of(last).is_none());
}
