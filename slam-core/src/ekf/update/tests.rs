use nalgebra::Vector3;

use super::*;
use crate::ekf::world::{INFLATION, PLAIN, SEEN, SURE, World, measurement};
use crate::geometry::pose::components;

#[test]
fn in_the_scope_of_a_line_only_that_line_changes() {
    let mut world = World::new(8);
    world.look();
    world.step(0.1, Vector3::zeros());
    let before = world.filter.clone();
    let entry = world.map.segments()[0];
    let slot = world.filter.activate(0, INFLATION, &mut world.map).unwrap();
    let seen = entry.segment().shifted(0.05, 0.1);
    let position = world.believed.translation.vector;
    let measurement = measurement(slot, &entry.segment(), &seen, position, SEEN);
    world.filter.update(&measurement, &PLAIN, UpdateScope::Line(slot));
    assert_eq!(world.filter.pose_covariance(), before.pose_covariance());
    let same = world.filter.commit(&world.believed, &mut world.map);
    assert_eq!(components(&same), components(&world.believed));
    let moved = world.map.segments()[0].segment().midpoint() - entry.segment().midpoint();
    assert!(moved.norm() > 0.01, "{moved}");
}

#[test]
fn the_test_uses_the_same_covariance_as_the_update() {
    let mut world = World::new(6);
    world.look();
    (0..30).for_each(|_| world.step(0.1, Vector3::zeros()));
    let position = world.believed.translation.vector;
    for index in 0..world.map.segments().len() {
        let entry = world.map.segments()[index];
        let Some(slot) = world.filter.slot_of(index) else { continue };
        let seen = entry.segment().shifted(0.02, 0.01);
        let measurement = measurement(slot, &entry.segment(), &seen, position, SEEN);
        let test = world.filter.test(&measurement);
        let mut with = [[0.0; STATES]; 2];
        world.filter.covariance_times(&measurement.jacobian, &mut with);
        for (state, [o, d]) in (0..STATES).map(|state| (state, [with[0][state], with[1][state]])) {
            let plain = measurement.jacobian.columns().fold([0.0; 2], |sums, (i, [by_o, by_d])| {
                let value = world.filter.covariance.get(state, i);
                [sums[0] + by_o * value, sums[1] + by_d * value]
            });
            assert!((o - plain[0]).abs() < 1e-6 && (d - plain[1]).abs() < 1e-6, "{state} of {index}");
        }
        let [known_o, _] = measurement.jacobian.times(&with[0]);
        let [_, known_d] = measurement.jacobian.times(&with[1]);
        for (gain, known) in test.information_ratio.iter().zip([known_o / SEEN[0], known_d / SEEN[1]]) {
            assert!((gain - known).abs() < 1e-2 * (1.0 + known), "{gain} {known} of {index}");
        }
        let gate = |max_nis| UpdateGate { max_nis, ..PLAIN };
        let mut doubting = world.filter.clone();
        assert!(!doubting.update(&measurement, &gate(0.99 * test.nis), UpdateScope::All));
        assert!(doubting.update(&measurement, &gate(1.01 * test.nis), UpdateScope::All));
    }
}

/// Of any scope: all, and in between the robot with a line, or a line alone.
#[test]
fn deferred_downdates_are_those_made_at_once() {
    let mut world = World::new(9);
    world.look();
    (0..30).for_each(|_| world.step(0.1, Vector3::zeros()));
    let position = world.believed.translation.vector;
    let tracked = (0..world.map.segments().len()).filter_map(|i| Some((i, world.filter.slot_of(i)?)));
    let measurements: std::vec::Vec<_> = tracked
        .map(|(index, slot)| {
            let segment = world.map.segments()[index].segment();
            let seen = segment.shifted(0.01 * world.gauss.draw(), 0.02 * world.gauss.draw());
            let scope = match index % 5 {
                2 => UpdateScope::RobotAndLine(slot),
                4 => UpdateScope::Line(slot),
                _ => UpdateScope::All,
            };
            (measurement(slot, &segment, &seen, position, SURE), scope)
        })
        .collect();
    assert!(measurements.len() > 8);
    let (mut one_by_one, mut at_once) = (world.filter.clone(), world.filter.clone());
    // Some innovations are left out.
    let gate = UpdateGate { kernel_nis: 2.0, min_information_ratio: 0.05, ..PLAIN };
    for (measurement, scope) in &measurements {
        one_by_one.update(measurement, &gate, *scope);
    }
    at_once.update_all(measurements.iter().map(|(m, scope)| (m, *scope)), &gate);
    for i in 0..STATES {
        let sigma = world.filter.covariance.get(i, i).sqrt();
        assert!((one_by_one.error_state[i] - at_once.error_state[i]).abs() <= 1e-3 * sigma, "{i}");
        for j in 0..=i {
            let most = sigma * world.filter.covariance.get(j, j).sqrt();
            assert!(
                (one_by_one.covariance.get(i, j) - at_once.covariance.get(i, j)).abs() <= 1e-4 * most,
                "{i} {j}"
            );
        }
    }
    let surer = |i: usize| at_once.covariance.get(i, i) < 0.9 * world.filter.covariance.get(i, i);
    let count = (0..STATES).filter(|i| surer(*i)).count();
    assert!(count > 10, "{count} states are surer");
}
