//! Every file of the fuzz corpus, read as its target reads it, without a fuzzer. The seeds are written by
//! `cargo test -p lineslam --test corpus -- --ignored`.

use std::path::{Path, PathBuf};

mod fuzz;
mod writers;

use writers::*;

fn folder(target: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus").join(target)
}

#[test]
fn no_file_of_the_corpus_makes_a_reader_panic() {
    for (target, format) in fuzz::TARGETS {
        let mut files = 0;
        for file in std::fs::read_dir(folder(target)).unwrap() {
            fuzz::read(format, &std::fs::read(file.unwrap().path()).unwrap());
            files += 1;
        }
        assert!(files > 0, "{target}");
    }
}

/// Numbers that are the same each time.
struct Noise(u64);

impl Noise {
    fn below(&mut self, end: usize) -> usize {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) as usize % end.max(1)
    }
}

/// Files as they should be, small ones.
fn good(target: &str) -> Vec<Vec<u8>> {
    let turned = [("wheel_left_joint", 1.0), ("wheel_right_joint", 2.0)];
    let moving = [("odom", "base_link", [1.0, 2.0, 0.0], quaternion(0.0, 0.5))];
    let all = |coding| {
        let mut messages = drive(coding, 3);
        messages.push(recorded("/joint_states", JOINTS, START, joints(coding, START, &turned)));
        messages.push(recorded("/tf", TF, START, transforms(coding, START, &moving)));
        messages
    };
    match target {
        "rosbag1" => {
            [Chunks::None, Chunks::Bz2, Chunks::Lz4].map(|chunks| ros1(&all(Coding::Ros1), chunks, 4)).to_vec()
        }
        "mcap" => [None, Some(mcap::Compression::Lz4), Some(mcap::Compression::Zstd)]
            .map(|compression| mcap_file(&all(Coding::Cdr), compression, Coding::Cdr))
            .to_vec(),
        "db3" => {
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join("seed.db3");
            db3(&path, &all(Coding::Cdr), false);
            vec![std::fs::read(&path).unwrap()]
        }
        "carmen" => vec![
            b"PARAM robot_frontlaser_offset 0.1\nODOM 0 0 0 0 0 0 1 h 1\nFLASER 3 1 2 3 0 0 0 0 0 0 1 h 1\n\
              FLASER 3 1 2 3 0.1 0 0 0.1 0 0 2 h 2\n"
                .to_vec(),
            b"ROBOTLASER1 0 -1.57 3.14 1.57 80 0.01 0 3 1 2 3 0 0 0 0 0 0 0 0 0 0 0 0 1 h 1\n".to_vec(),
            b"RAWLASER1 0 -1.57 3.14 1.57 80 0.01 0 3 1 2 81.9 0 1 h 1\n# a comment\n".to_vec(),
        ],
        "plain" => vec![
            b"{\"lineslam_log\":1,\"sensor\":{\"first_bearing_deg\":-90,\"step_deg\":90,\"max_range_m\":5}}\n\
              {\"t_us\":1000000,\"ranges_m\":[1,2,3]}\n{\"t_us\":1000000,\"pose\":[0,0,0]}\n"
                .to_vec(),
            b"{\"t_us\":1000000,\"ticks\":[1,2]}\n{\"t_us\":2000000,\"ticks\":[3,4],\"ranges_mm\":[1000,null,3000]}\n"
                .to_vec(),
        ],
        _ => {
            let line = |words: usize, t: u32| (0..words).map(|w| if w == 0 { t } else { 700 }.to_string() + " ").collect::<String>();
            vec![format!("{}\n{}\n", line(707, 1), line(706, 100_000)).into_bytes(), b"1 2 3\n".to_vec()]
        }
    }
}

#[test]
#[ignore = "writes the seeds"]
fn write_seeds() {
    const SEEDS: usize = 25;
    for (target, _) in fuzz::TARGETS {
        let mut noise = Noise(1);
        let good = good(target);
        let mut seeds = good.clone();
        seeds.push(Vec::new());
        while seeds.len() < SEEDS {
            let mut bytes = good[seeds.len() % good.len()].clone();
            match seeds.len() % 3 {
                0 => bytes.truncate(noise.below(bytes.len())),
                1 => {
                    let (at, value) = (noise.below(bytes.len()), noise.below(256) as u8);
                    bytes[at] = value;
                }
                _ => {
                    let (from, to) = (noise.below(bytes.len()), noise.below(bytes.len()));
                    let end = (from + 8).min(bytes.len());
                    let copied = bytes[from..end].to_vec();
                    let to = to.min(bytes.len() - copied.len());
                    bytes[to..to + copied.len()].copy_from_slice(&copied);
                }
            }
            seeds.push(bytes);
        }
        std::fs::create_dir_all(folder(target)).unwrap();
        for (index, seed) in seeds.iter().enumerate() {
            assert!(seed.len() < 25_000, "{target}: {} bytes", seed.len());
            std::fs::write(folder(target).join(format!("seed-{index:02}")), seed).unwrap();
        }
    }
}
