//! `lineslam experiments`.

use std::path::{Path, PathBuf};

use lineslam::experiments::{self, document, kidnapped, kinds_page};
use lineslam::output;

use super::common::progress_bar;

#[derive(clap::Args)]
pub struct Args {
    /// Drives of each building.
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..=1000))]
    seeds: u32,
    /// Seed of the first drive; the others follow.
    #[arg(long, default_value_t = 1001)]
    first_seed: u64,
    /// RANSAC seeds of each drive, for the paper's configurations.
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=100))]
    ransac_seeds: u64,
    /// Folder of the worlds hall, corridor, office, lab, flat, twins, loop and parallel.
    #[arg(long, value_name = "FOLDER", default_value = "worlds")]
    worlds: PathBuf,
    /// Folder for experiments.md and images/.
    #[arg(long, value_name = "FOLDER", default_value = "docs")]
    out: PathBuf,
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let seeds = args.first_seed..args.first_seed.saturating_add(u64::from(args.seeds));
    let options =
        experiments::Options { worlds: args.worlds.clone(), seeds, ransac_seeds: args.ransac_seeds };
    let progress = progress_bar(experiments::steps(&options), "drives");
    let results = experiments::run(&options, || progress.inc(1))?;
    progress.finish_and_clear();
    let command = format!(
        "cargo run --release -p lineslam -- experiments --seeds {} --first-seed {} --ransac-seeds {}",
        args.seeds, args.first_seed, args.ransac_seeds
    );
    let page = document::render(&results, &command, "images");
    let mut files: Vec<(PathBuf, Vec<u8>)> = vec![("experiments.md".into(), page.into_bytes())];
    files.extend(
        results
            .figures
            .iter()
            .map(|(name, text)| (Path::new("images").join(name), text.clone().into_bytes())),
    );
    output::write_all(&args.out, &files)?;
    println!("{}\n", kinds_page::missed(&results.runs));
    println!("{}\n\n{}\n", kinds_page::corners(&results), kinds_page::trajectories(&results));
    println!("{}\n\n{}", document::buildings(&results), document::robustness(&results));
    println!("\n{}\n\n{}", kidnapped::fates(&results), document::honesty(&results));
    println!("\n{}", document::featureless(&results));
    println!("\nwritten to {}", args.out.join("experiments.md").display());
    Ok(())
}
