//! `lineslam scan`.

use std::path::PathBuf;

use comfy_table::{Table, presets};
use lineslam::output::scan::{self, Beams};
use lineslam::serial::{self, OneScan};
use slam_core::sensor::scan::{RangeCodes, ScanGeometry};

use super::common::write_one;

#[derive(clap::Args)]
pub struct Args {
    /// Serial port of the sensor, such as /dev/ttyACM0.
    #[arg(long, value_name = "DEVICE")]
    port: String,
    /// Bit rate to work at; a sensor on USB takes any.
    #[arg(long, default_value_t = 115_200, value_name = "BIT/S")]
    baud_rate: u32,
    /// Attempts to connect.
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=1000))]
    attempts: u32,
    /// The drawing.
    #[arg(long, value_name = "FILE", default_value = "scan.svg")]
    out: PathBuf,
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let OneScan { info, baud_rate, ranges_mm } = serial::one_scan(&args.port, args.baud_rate, args.attempts)?;
    let (geometry, codes) = (ScanGeometry::from(&info), RangeCodes::from(&info));
    let beams = Beams::count(&ranges_mm, &codes);
    let seen = format!(
        "{} ranges, {} beams with nothing in range, {} not measured",
        beams.ranges, beams.no_echo, beams.bad
    );
    let title = format!("{} {}", info.product, info.serial);
    write_one(&args.out, scan::render(&title, &seen, &geometry, &codes, &ranges_mm))?;
    let degrees = |beam: usize| geometry.bearing(beam).to_degrees();
    let field = format!(
        "{} beams from {:.1}° to {:.1}°, {} to {} mm, {} rpm",
        info.beams(),
        degrees(0),
        degrees(info.beams() - 1),
        info.min_range_mm,
        info.max_range_mm,
        info.revolutions_per_minute
    );
    let mut table = Table::new();
    table.load_style(presets::NOTHING);
    let rows = [
        ("port", format!("{} at {baud_rate} bit/s", args.port)),
        ("model", info.model.to_string()),
        ("vendor", info.vendor.to_string()),
        ("product", info.product.to_string()),
        ("firmware", info.firmware.to_string()),
        ("protocol", info.protocol.to_string()),
        ("serial number", info.serial.to_string()),
        ("field of view", field),
        ("scan", seen),
        ("written to", args.out.display().to_string()),
    ];
    for (name, value) in rows {
        table.add_row([name.to_owned(), value]);
    }
    println!("{table}");
    Ok(())
}
