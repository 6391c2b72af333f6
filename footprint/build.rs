//! Names the program's entry, which keeps what it calls.
fn main() {
    if std::env::var("CARGO_CFG_TARGET_OS").is_ok_and(|os| os == "none") {
        println!("cargo::rustc-link-arg-bins=--entry=everything");
    }
}
