//! `lineslam benchmark`.

use std::path::{Path, PathBuf};

use lineslam::benchmark::{self, page, tables};
use lineslam::output;

use super::common::progress_bar;

#[derive(clap::Args)]
pub struct Args {
    /// Folder of recorded logs, searched with the folders below it. NAME.ref.tum beside a log is its reference; the nearest
    /// NAME.relations of its time has its relations. docs/benchmark.md says where to get logs.
    #[arg(long, value_name = "FOLDER", env = "LINESLAM_DATA")]
    data: PathBuf,
    /// Replay only these logs: names of drives, such as fr079, or of files.
    #[arg(long, value_name = "NAME,...", value_delimiter = ',')]
    logs: Vec<String>,
    /// Folder for benchmark.md and images/.
    #[arg(long, value_name = "FOLDER", default_value = "docs")]
    out: PathBuf,
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let found = benchmark::find(&args.data, &args.logs)?;
    let progress = progress_bar(found.len(), "logs");
    let measured = found.into_iter().map(|log| {
        let row = benchmark::measure(log, &args.data);
        progress.inc(1);
        row
    });
    let rows: Vec<benchmark::Row> = measured.collect();
    progress.finish_and_clear();
    let only = if args.logs.is_empty() { String::new() } else { format!(" --logs {}", args.logs.join(",")) };
    let command = format!("cargo run --release -p lineslam -- benchmark --data LOGS{only}");
    let text = page::render(&rows, &command, "images");
    let mut files: Vec<(PathBuf, Vec<u8>)> = vec![("benchmark.md".into(), text.into_bytes())];
    for row in &rows {
        if let Ok(measured) = &row.outcome {
            let path = Path::new("images").join(page::image(&row.found));
            files.push((path, measured.figure.clone().into_bytes()));
        }
    }
    output::write_all(&args.out, &files)?;
    println!("{}", tables::summary(&rows));
    for remark in page::remarks(&rows) {
        println!("{remark}");
    }
    println!("\nwritten to {}", args.out.join("benchmark.md").display());
    Ok(())
}
