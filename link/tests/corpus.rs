//! Replays what is of interest to the fuzzer; see `fuzz/`.

mod fuzz;

use std::path::Path;

#[test]
fn the_receiver_s_corpus() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus/receiver");
    let files = std::fs::read_dir(&folder).unwrap_or_else(|e| panic!("{}: {e}", folder.display()));
    let (mut replayed, mut found) = (0, 0);
    for file in files {
        let path = file.expect("a directory entry").path();
        found += fuzz::receiver(&std::fs::read(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display())));
        replayed += 1;
    }
    println!("{replayed} inputs, {found} messages");
    assert!(replayed >= 20 && found >= 12, "{}: {replayed} inputs, {found} messages", folder.display());
}
