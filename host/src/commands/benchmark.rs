//! `lineslam benchmark`.

use std::path::{Path, PathBuf};

use lineslam::benchmark::{self, Noise, page, tables};
use lineslam::output;

use super::common::progress_bar;

/// Noise that replays are repeated with unless something else is asked for, metres: less than the scanners' own, a centimetre or
/// more.
const RANGE_NOISE_M: f64 = 0.005;

fn noise_m(word: &str) -> Result<f64, String> {
    let sigma_m: f64 = word.parse().map_err(|_| "not a number".to_owned())?;
    if (0.0..=1.0).contains(&sigma_m) { Ok(sigma_m) } else { Err("not from 0 to 1 m".into()) }
}

#[derive(clap::Args)]
pub struct Args {
    /// Folder of recorded logs, searched with the folders below it. NAME.ref.tum beside a log is its reference; the nearest
    /// NAME.relations of its time has its relations. docs/benchmark.md says where to get logs.
    #[arg(long, value_name = "FOLDER", env = "LINESLAM_DATA")]
    data: PathBuf,
    /// Replay only these logs: names of drives, such as fr079, or of files.
    #[arg(long, value_name = "NAME,...", value_delimiter = ',')]
    logs: Vec<String>,
    /// Replay each log so many times more, with noise on its ranges, and say how far its error moves: median and worst beside
    /// the plain one. 0 is not at all.
    #[arg(long, value_name = "N", default_value_t = 0)]
    runs: usize,
    /// Standard deviation of that noise, metres. It is Gaussian, from the seeds 1 to N, on every range that is a distance; codes
    /// stay as they are.
    #[arg(long, value_name = "METRES", default_value_t = RANGE_NOISE_M, value_parser = noise_m, requires = "runs")]
    range_noise: f64,
    /// Folder for benchmark.md and images/.
    #[arg(long, value_name = "FOLDER", default_value = "docs")]
    out: PathBuf,
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let found = benchmark::find(&args.data, &args.logs)?;
    let noise = Noise { runs: args.runs, sigma_m: args.range_noise };
    let progress = progress_bar(found.len(), "logs");
    let measured = found.into_iter().map(|log| {
        let row = benchmark::measure(log, &args.data, &noise);
        progress.inc(1);
        row
    });
    let rows: Vec<benchmark::Row> = measured.collect();
    progress.finish_and_clear();
    let only = if args.logs.is_empty() { String::new() } else { format!(" --logs {}", args.logs.join(",")) };
    let command = format!("cargo run --release -p lineslam -- benchmark --data LOGS{only}{}", again(&noise));
    let text = page::render(&rows, &command, &noise, "images");
    let mut files: Vec<(PathBuf, Vec<u8>)> = vec![("benchmark.md".into(), text.into_bytes())];
    for row in &rows {
        if let Ok(measured) = &row.outcome {
            let path = Path::new("images").join(page::image(&row.found));
            files.push((path, measured.figure.clone().into_bytes()));
        }
    }
    output::write_all(&args.out, &files)?;
    println!("{}", tables::summary(&rows));
    if let Some(table) = tables::firm_summary(&rows) {
        println!(
            "{} times more, with {} mm of noise on the ranges:\n{table}",
            noise.runs,
            1e3 * noise.sigma_m
        );
    }
    for remark in page::remarks(&rows) {
        println!("{remark}");
    }
    println!("\nwritten to {}", args.out.join("benchmark.md").display());
    Ok(())
}

/// The options that ask for this noise.
fn again(noise: &Noise) -> String {
    match (noise.runs, noise.sigma_m) {
        (0, _) => String::new(),
        (runs, sigma_m) if sigma_m == RANGE_NOISE_M => format!(" --runs {runs}"),
        (runs, sigma_m) => format!(" --runs {runs} --range-noise {sigma_m}"),
    }
}
