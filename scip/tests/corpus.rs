//! Replays what the fuzzer has found to be of interest; see `fuzz/`.

mod fuzz;
mod world;

use std::path::Path;

fn replay(target: &str, run: impl Fn(&[u8])) {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus").join(target);
    let files = std::fs::read_dir(&folder).unwrap_or_else(|e| panic!("{}: {e}", folder.display()));
    let mut replayed = 0;
    for file in files {
        let path = file.expect("a directory entry").path();
        run(&std::fs::read(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display())));
        replayed += 1;
    }
    assert!(replayed >= 20, "{}: {replayed} inputs", folder.display());
    println!("{target}: {replayed} inputs");
}

#[test]
fn the_decoder_s_corpus() {
    replay("decoder", fuzz::decoder);
}

#[test]
fn the_client_s_corpus() {
    replay("client", fuzz::client);
}
