//! Robots that somebody lifts and puts down elsewhere in the building that they have mapped.

use std::path::Path;

use lineslam::experiments::kidnapped::{PLACES, Place, lifted};
use lineslam::sim::world::World;

/// Seeds that nothing was chosen on.
const SEEDS: std::ops::Range<u64> = 301..304;

#[test]
fn lifted_robots_say_that_they_are_lost_and_find_themselves() {
    let (mut drives, mut soon) = (0, 0);
    for (name, at_s) in [("flat", 120.0), ("lab", 60.0)] {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("../worlds/{name}.toml"));
        let world = World::load(&path).unwrap();
        for (place, Place { name: put_down, .. }) in PLACES.iter().enumerate() {
            for seed in SEEDS {
                let told = lifted(name, &world, at_s, place, seed).unwrap();
                let case = format!("{name}, {put_down}, seed {seed}: {told:?}");
                println!("{case}");
                assert!(told.said_lost_s.is_some_and(|s| s < 2.0), "{case}");
                assert!(told.wrong_and_sure_s < 0.5, "{case}");
                drives += 1;
                soon += usize::from(told.found_s.is_some_and(|s| s < 5.0));
            }
        }
    }
    println!("found within 5 s: {soon} of {drives}");
    assert!(6 * soon >= 5 * drives, "{soon} of {drives}");
}
