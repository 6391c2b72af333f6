//! Time of a scan on the PC, over beams and map segments: `cargo bench -p lineslam`, or with everything else
//! `cargo xtask performance`.

use std::hint::black_box;
use std::path::Path;

use criterion::{BatchSize, BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use lineslam::robot::Robot;
use lineslam::sim::fixed_set::FixedSet;
use slam_core::{Scan, Slam};

/// Beams over 240°.
const BEAMS: [usize; 6] = [90, 181, 361, 682, 1081, 2048];
/// Segments of the map.
const SEGMENTS: [usize; 6] = [50, 100, 200, 500, 1000, 2000];
/// Of the sweep over beams.
const SEGMENTS_OF_SWEEP: usize = 200;
/// Scans of a run.
const SCANS: usize = 60;
/// The robot, whose scanner is given other numbers of beams.
const ROBOT: &str = "../robots/paper.toml";
const WORLD: &str = "../worlds/office.toml";

/// The robot with so many beams over the same 240°.
fn robot(beams: usize) -> Robot {
    let text = std::fs::read_to_string(ROBOT).expect("the robot file is there");
    let mut table: toml::Table = text.parse().expect("the robot file is TOML");
    let sensor = table["sensor"].as_table_mut().expect("it has a sensor");
    let steps = sensor.entry("steps").or_insert(toml::Table::new().into());
    let steps = steps.as_table_mut().expect("sensor.steps is a table");
    let last = beams as i64 - 1;
    steps.insert("first".into(), 0.into());
    steps.insert("last".into(), last.into());
    steps.insert("front".into(), (last / 2).into());
    steps.insert("per_revolution".into(), (1.5 * last as f64).into());
    steps.insert("used".into(), vec![0, last].into());
    let file = tempfile::NamedTempFile::new().expect("a file for a robot");
    std::fs::write(file.path(), table.to_string()).expect("a robot can be written");
    Robot::load(file.path()).expect("a robot with other beams")
}

/// The scans of the set through a core that knows the map.
fn run<const N: usize, const BEAMS: usize>(slam: &mut Slam<N, BEAMS>, set: &FixedSet) {
    for (ranges_mm, motion) in set.ranges_mm.iter().zip(&set.motions) {
        black_box(slam.process_scan(&Scan { ranges_mm }, motion));
    }
}

fn knowing<const N: usize, const BEAMS: usize>(set: &FixedSet, segments: usize) -> Box<Slam<N, BEAMS>> {
    let mut slam = Box::new(Slam::new(set.config).expect("the robot's configuration"));
    slam.take_up(set.map(segments).into_iter(), set.begin);
    slam
}

fn sweep(criterion: &mut Criterion) {
    let mut beams = criterion.benchmark_group("beams");
    beams.throughput(Throughput::Elements(SCANS as u64)).sample_size(20);
    for count in BEAMS {
        let set = FixedSet::new(Path::new(WORLD), &robot(count), SCANS).expect("a set");
        beams.bench_function(BenchmarkId::from_parameter(count), |b| {
            let fresh = || knowing::<512, 2048>(&set, SEGMENTS_OF_SWEEP);
            b.iter_batched_ref(fresh, |slam| run(slam, &set), BatchSize::LargeInput);
        });
    }
    beams.finish();
    let set = FixedSet::new(Path::new(WORLD), &robot(682), SCANS).expect("a set");
    let mut segments = criterion.benchmark_group("segments");
    segments.throughput(Throughput::Elements(SCANS as u64)).sample_size(20);
    for count in SEGMENTS {
        segments.bench_function(BenchmarkId::from_parameter(count), |b| {
            let fresh = || knowing::<2048, 682>(&set, count);
            b.iter_batched_ref(fresh, |slam| run(slam, &set), BatchSize::LargeInput);
        });
    }
    segments.finish();
}

criterion_group!(benches, sweep);
criterion_main!(benches);
