//! The ELF: what the emulator must know of it, and its log.

use std::path::Path;

use anyhow::{Context, bail};
use defmt_decoder::{DecodeError, StreamDecoder, Table};
use object::{Object, ObjectSection, ObjectSymbol, SectionKind};
use rigless::emulator::Host;
use rigless::soc::Width;

/// Addresses in the firmware's memory.
#[derive(Clone, Copy, Debug)]
pub struct Symbols {
    /// The control block of RTT.
    pub rtt: u64,
    /// The record of what was done to the map.
    pub trace: u64,
    /// Where a firmware that does so looks for orders.
    pub order: Option<u64>,
    /// Bytes of all variables.
    pub static_bytes: u64,
}

impl Symbols {
    /// Reads them from the ELF.
    pub fn read(elf: &[u8], path: &Path) -> anyhow::Result<Self> {
        let file = object::File::parse(elf).with_context(|| path.display().to_string())?;
        let variables = file
            .sections()
            .filter(|s| matches!(s.kind(), SectionKind::Data | SectionKind::UninitializedData))
            .map(|s| s.size());
        Ok(Self {
            rtt: address_of(RTT, elf, path)?,
            trace: address_of("TRACE", elf, path)?,
            order: file.symbol_by_name("ORDER").map(|symbol| symbol.address()),
            static_bytes: variables.sum(),
        })
    }

    /// The control block of RTT of any firmware.
    pub fn rtt(elf: &[u8], path: &Path) -> anyhow::Result<u64> {
        address_of(RTT, elf, path)
    }
}

const RTT: &str = "_SEGGER_RTT";

fn address_of(name: &str, elf: &[u8], path: &Path) -> anyhow::Result<u64> {
    let file = object::File::parse(elf).with_context(|| path.display().to_string())?;
    let symbol = file.symbols().find(|s| s.name() == Ok(name));
    symbol.map(|s| s.address()).with_context(|| format!("{}: there is no symbol {name}", path.display()))
}

/// A line of the log.
#[derive(Clone, Debug)]
pub struct LogLine {
    /// On the firmware's clock, as it prints it.
    pub stamp: String,
    /// `INFO`, `WARN`, `ERROR`.
    pub level: String,
    /// The text.
    pub text: String,
}

impl std::fmt::Display for LogLine {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} {:<5} {}", self.stamp, self.level, self.text)
    }
}

/// Reads the firmware's RTT and decodes it, as a probe does.
pub struct Log {
    rtt: u64,
    decoder: Box<dyn StreamDecoder + Send + Sync>,
}

impl Log {
    /// Of a firmware.
    pub fn new(elf: &[u8], path: &Path, rtt: u64) -> anyhow::Result<Self> {
        let table = Table::parse(elf)?.with_context(|| format!("{}: it has no defmt log", path.display()))?;
        // One for each run of a program that runs once.
        let table: &'static Table = Box::leak(Box::new(table));
        Ok(Self { rtt, decoder: table.new_stream_decoder() })
    }

    /// Takes what the firmware has written since the last time.
    pub fn drain(&mut self, host: &mut dyn Host, lines: &mut Vec<LogLine>) -> anyhow::Result<()> {
        // The first up channel: name, buffer, size, write offset, read offset, flags.
        const UP: u64 = 24;
        const BLOCK_IF_FULL: u64 = 2;
        let word = |host: &mut dyn Host, at: u64| host.read(self.rtt + at, Width::W32);
        let id = word(host, 0)?;
        if id != u64::from(u32::from_le_bytes(*b"SEGG")) {
            return Ok(());
        }
        if word(host, UP + 20)? != BLOCK_IF_FULL {
            host.write(self.rtt + UP + 20, Width::W32, BLOCK_IF_FULL)?;
        }
        let (buffer, size) = (word(host, UP + 4)?, word(host, UP + 8)?);
        let (write, mut read) = (word(host, UP + 12)?, word(host, UP + 16)?);
        if size == 0 || write >= size || read >= size {
            return Ok(());
        }
        let mut bytes = Vec::new();
        while read != write {
            bytes.push(host.read(buffer + read, Width::W8)? as u8);
            read = (read + 1) % size;
        }
        if bytes.is_empty() {
            return Ok(());
        }
        host.write(self.rtt + UP + 16, Width::W32, read)?;
        self.decoder.received(&bytes);
        self.decode(lines)
    }

    fn decode(&mut self, lines: &mut Vec<LogLine>) -> anyhow::Result<()> {
        // A frame cut by a reset spoils itself and at most the next; a log of nothing else is no log of this firmware.
        for _ in 0..1000 {
            match self.decoder.decode() {
                Ok(frame) => lines.push(LogLine {
                    stamp: frame.display_timestamp().map(|s| s.to_string()).unwrap_or_default(),
                    level: frame.level().map_or_else(String::new, |l| l.as_str().to_uppercase()),
                    text: frame.display_message().to_string(),
                }),
                Err(DecodeError::UnexpectedEof) => return Ok(()),
                Err(DecodeError::Malformed) => {}
            }
        }
        bail!("the log cannot be decoded")
    }
}
