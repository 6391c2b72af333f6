//! The benchmark firmware's runs, and what they counted: instructions, and the cycles that the model makes of them.

use std::path::Path;

use anyhow::{Context, bail, ensure};
use comfy_table::{Table, presets};
use rigless::emulator::{self, Driver, Host, Start, Stop};
use rigless::image::Image;
use rigless::session::Session;
use rigless::time::VirtualNanos;
use slam_core::slam::Stage;

use crate::board::{CLOCK_HZ, CYCLES_PER_INSTRUCTION, Nucleo, check_assumed_cycles};
use crate::cycles::{Cause, Program};
use crate::firmware::{Log, LogLine, Symbols};
use crate::paced::Pace;

/// The clock of the part after a reset. At as many instructions a second, the cycle counter counts instructions.
const RESET_HZ: u64 = 16_000_000;
/// The log is read this often, microseconds of virtual time.
const GRID_US: u64 = 1000;
/// A firmware that has not ended by then never will, microseconds of virtual time.
const LONGEST_US: u64 = 3_600_000_000;

/// Instructions that a scan may take with the default configuration and [`BUDGET_SEGMENTS`] segments: median and 99th percentile.
const BUDGET: [u32; 2] = [200_000, 600_000];
const BUDGET_SEGMENTS: usize = 200;
/// Instructions of any scan in which the pose is searched for, whatever the map.
const SEARCH_BUDGET: u32 = 2_000_000;
/// Between two scans.
const SCAN_S: f64 = 0.1;

/// Loops counted by hand, with what [`crate::cycles`] says of their kind of instruction: instructions and cycles of a turn. The
/// last two of each are `subs` and the branch back, one cycle and two.
const KERNELS: [(&str, u32, u32); 9] = [
    ("adds", 2 + 2, 2 + 3),
    // The second waits for the first.
    ("dependent", 2 + 2, 3 + 3),
    ("divisions", 1 + 2, 14 + 3),
    ("multiply", 1 + 2, 3 + 3),
    // Two for the first, one for each that follows it.
    ("loads", 4 + 2, 5 + 3),
    // The load waits for its address.
    ("addresses", 2 + 2, 1 + 3 + 3),
    // Four registers to the stack and back.
    ("lists", 2 + 2, 5 + 5 + 3),
    // There two, back three.
    ("calls", 2 + 2, 2 + 3 + 3),
    // 24 instructions of four bytes: each of the six lines after the first comes two cycles late.
    ("lines", 24 + 2, 24 + 6 * 2 + 3),
];

/// Both counts.
#[derive(Debug)]
pub struct Report {
    /// On a core whose every instruction takes one cycle.
    instructions: Measured,
    /// On one that takes its time; the default configuration only.
    cycles: Measured,
    /// What the cycles went into.
    pace: Pace,
}

/// All that was counted.
#[derive(Debug, Default)]
pub struct Measured {
    /// Loops counted by hand: name, turns, instructions or cycles.
    pub kernels: Vec<(String, u32, u32)>,
    /// Transcendental functions.
    pub functions: Vec<Function>,
    /// Runs over the set of scans.
    pub runs: Vec<Run>,
}

/// A function of libm or of the core, and micromath's, over some arguments.
#[derive(Clone, Debug, PartialEq)]
pub struct Function {
    /// What it computes.
    pub name: String,
    /// Instructions or cycles of both.
    pub instructions: [u32; 2],
    /// Largest error of both, against libm in double precision.
    pub errors: [f32; 2],
}

/// The set of scans with one configuration and map.
#[derive(Debug)]
pub struct Run {
    /// Of the configuration.
    pub name: String,
    /// Segments of the map at the start.
    pub known: usize,
    /// Scan by scan.
    pub scans: Vec<Counted>,
}

/// One scan.
#[derive(Clone, Copy, Debug)]
pub struct Counted {
    /// Instructions or cycles of each stage.
    pub stages: [u32; Stage::COUNT],
    /// Points of the scan.
    pub points: u32,
    /// Whether it was a keyframe.
    pub keyframe: bool,
    /// Segments of the map afterwards.
    pub segments: usize,
    /// Whether the pose was searched for.
    pub searched: bool,
}

impl Counted {
    /// Of all stages.
    pub fn total(&self) -> u32 {
        self.stages.iter().sum()
    }
}

/// Runs the firmware on both cores, side by side; shows the log of the first.
pub fn run(path: &Path, show: bool) -> anyhow::Result<Report> {
    let elf = std::fs::read(path).with_context(|| path.display().to_string())?;
    let pace = Pace::new(Program::read(&elf, path)?);
    let copy = elf.clone();
    let (instructions, cycles) = std::thread::scope(|threads| {
        let instructions = threads.spawn(|| measure(path, copy, show, None));
        let cycles = measure(path, elf, false, Some(&pace));
        (instructions.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)), cycles)
    });
    Ok(Report { instructions: instructions?, cycles: cycles?, pace })
}

/// Runs it to its end; with a pace until the default configuration is measured.
fn measure(path: &Path, elf: Vec<u8>, show: bool, pace: Option<&Pace>) -> anyhow::Result<Measured> {
    let rtt = Symbols::rtt(&elf, path)?;
    let board = Nucleo::bare(RESET_HZ, pace.cloned())?;
    let session = Session::new(Box::new(board), 0, VirtualNanos(GRID_US * 1000))?;
    let end = if pace.is_some() { "run paper" } else { "end of benchmark" };
    let reader = Reader { log: Log::new(&elf, path, rtt)?, lines: Vec::new(), show, end, failure: None };
    let images = [Image::new(path, elf, None)?];
    let mut finished = emulator::run(session, &Start::new(&images), reader)?;
    if let Some(error) = finished.driver.failure.take() {
        return Err(error);
    }
    if let Some(error) = finished.session.take_error() {
        return Err(error.into());
    }
    let mut measured = Measured::default();
    for line in finished.driver.lines.iter().take_while(|line| !line.text.starts_with(end)) {
        measured.take(&line.text).with_context(|| format!("the firmware says: {}", line.text))?;
    }
    Ok(measured)
}

/// Reads the log until the benchmark's end.
struct Reader {
    log: Log,
    lines: Vec<LogLine>,
    show: bool,
    /// What the last line begins with.
    end: &'static str,
    failure: Option<anyhow::Error>,
}

impl Driver<Nucleo> for Reader {
    fn on_stop(&mut self, _: &mut Session<Nucleo>, stop: Stop, host: &mut dyn Host) -> Option<VirtualNanos> {
        let before = self.lines.len();
        if let Err(error) = self.log.drain(host, &mut self.lines) {
            self.failure = Some(error);
            return None;
        }
        for line in self.lines.iter().skip(before).filter(|_| self.show) {
            println!("{line}");
        }
        if self.lines.iter().skip(before).any(|l| l.text.starts_with(self.end)) {
            return None;
        }
        if stop.at.0 / 1000 > LONGEST_US {
            self.failure = Some(anyhow::anyhow!("the firmware does not come to an end"));
            return None;
        }
        Some(VirtualNanos(stop.at.0 + GRID_US * 1000))
    }
}

impl Measured {
    fn take(&mut self, text: &str) -> anyhow::Result<()> {
        let (what, rest) = text.split_once(' ').context("a line of one word")?;
        match what {
            "kernel" => {
                let words: Vec<&str> = rest.split(' ').collect();
                let [name, turns, instructions] = words[..] else { bail!("three words are expected") };
                self.kernels.push((name.to_owned(), turns.parse()?, instructions.parse()?));
            }
            "function" => {
                let words: Vec<&str> = rest.split(' ').collect();
                let [name, ours, micromath, error, micromath_error] = words[..] else {
                    bail!("five words are expected")
                };
                self.functions.push(Function {
                    name: name.to_owned(),
                    instructions: [ours.parse()?, micromath.parse()?],
                    errors: [error.parse()?, micromath_error.parse()?],
                });
            }
            "run" => {
                let (name, known) = rest.split_once(' ').context("two words are expected")?;
                self.runs.push(Run { name: name.to_owned(), known: known.parse()?, scans: Vec::new() });
            }
            "scan" => {
                let (stages, rest) =
                    rest.strip_prefix('[').and_then(|r| r.split_once("] ")).context("no list of stages")?;
                let counts: Vec<u32> = stages.split(", ").map(str::parse).collect::<Result<_, _>>()?;
                let words: Vec<&str> = rest.split(' ').collect();
                let [points, keyframe, segments, searched] = words[..] else {
                    bail!("four words are expected")
                };
                let scan = Counted {
                    stages: counts.try_into().ok().context("another number of stages")?,
                    points: points.parse()?,
                    keyframe: keyframe.parse()?,
                    segments: segments.parse()?,
                    searched: searched.parse()?,
                };
                self.runs.last_mut().context("a scan before its run")?.scans.push(scan);
            }
            _ => bail!("this is no line of the benchmark"),
        }
        Ok(())
    }

    /// Prints a line of percentiles for each run.
    fn print_stages(&self) {
        let mut table = Table::new();
        table.load_style(presets::NOTHING);
        let stages = Stage::ALL.map(|s| format!("{s:?}").to_lowercase());
        table.set_header(
            ["configuration", "segments"].map(String::from).into_iter().chain(stages).chain(["all".into()]),
        );
        for run in &self.runs {
            let stage = |i: usize| cell(run.percentiles(|s| s.stages[i]));
            let row = [run.name.clone(), run.known.to_string()]
                .into_iter()
                .chain((0..Stage::COUNT).map(stage))
                .chain([cell(run.percentiles(Counted::total))]);
            table.add_row(row);
        }
        println!("{table}");
    }

    fn print_scans(&self) {
        for run in &self.runs {
            let n = run.scans.len() as f64;
            let points = run.scans.iter().map(|s| f64::from(s.points)).sum::<f64>() / n;
            let of = |keyframe: bool| {
                let [median, _, _] =
                    percentiles(run.scans.iter().filter(|s| s.keyframe == keyframe).map(Counted::total));
                median
            };
            println!(
                "{} {}: {points:.0} points a scan; {} keyframes, median {}, of the others {}; {} segments at the end",
                run.name,
                run.known,
                run.scans.iter().filter(|s| s.keyframe).count(),
                of(true),
                of(false),
                run.scans.last().map_or(0, |s| s.segments)
            );
        }
    }

    /// Median and 99th percentile of the run that has a budget.
    fn budgeted(&self) -> anyhow::Result<[u32; 2]> {
        let run = self.runs.iter().find(|r| r.name == "default" && r.known == BUDGET_SEGMENTS);
        let [median, p99, _] =
            run.context("the run that has a budget is missing")?.percentiles(Counted::total);
        Ok([median, p99])
    }

    /// How many scans searched for the pose, around the prediction or everywhere, and what the dearest of them took.
    fn searches(&self, everywhere: bool) -> [u32; 2] {
        let runs = self.runs.iter().filter(|run| (run.name == "relocalising") == everywhere);
        let scans = runs.flat_map(|run| &run.scans).filter(|scan| scan.searched);
        scans.fold([0, 0], |[count, most], scan| [count + 1, most.max(scan.total())])
    }

    /// What a loop costs for each turn.
    fn turn(&self, name: &str) -> anyhow::Result<u32> {
        let kernel = self.kernels.iter().find(|(kernel, _, _)| kernel == name);
        kernel.map(|(_, turns, count)| count / turns).with_context(|| format!("the loop {name} is missing"))
    }
}

impl Report {
    /// Prints all of it. Fails over the budget, and where a count is not the one by hand.
    pub fn print(&self) -> anyhow::Result<()> {
        let Self { instructions, cycles, .. } = self;
        let scans = instructions.runs.first().map_or(0, |r| r.scans.len());
        println!("instructions for each scan of {scans} scans, median / p99 / max");
        instructions.print_stages();
        instructions.print_scans();
        println!("\ncycles for each of them by the model, median / p99 / max");
        cycles.print_stages();
        self.print_causes();
        println!(
            "\nfunction: instructions and largest error of libm (sin_cos and sqrt: of the core), of micromath"
        );
        for Function { name, instructions: [ours, micromath], errors: [error, micromath_error] } in
            &instructions.functions
        {
            println!("{name:<8} {ours:>6} {error:>8.1e} {micromath:>6} {micromath_error:>8.1e}");
        }
        let wrong = self.print_kernels()?;
        let [median, p99] = instructions.budgeted()?;
        println!(
            "\ndefault, {BUDGET_SEGMENTS} segments: median {median}, p99 {p99} instructions; {} and {} are allowed",
            BUDGET[0], BUDGET[1]
        );
        let searches = [("search for the pose", false), ("search everywhere", true)].map(|(name, everywhere)| {
            let [scans, dearest] = instructions.searches(everywhere);
            println!("{name}: {dearest} instructions at the most, of {scans} scans; {SEARCH_BUDGET} are allowed");
            (name, scans, dearest)
        });
        let share = |count: u32| 100.0 * f64::from(count) / (CLOCK_HZ.get() as f64 * SCAN_S);
        let timed = cycles.budgeted()?;
        println!(
            "in cycles {} and {}: {:.1} % and {:.1} % of the time between two scans at {} MHz",
            timed[0],
            timed[1],
            share(timed[0]),
            share(timed[1]),
            CLOCK_HZ.get() / 1_000_000
        );
        ensure!(wrong.is_empty(), "these loops do not cost what they cost by hand: {}", wrong.join(", "));
        self.pace.tally.check_known()?;
        ensure!(
            median <= BUDGET[0] && p99 <= BUDGET[1],
            "a scan takes {median} instructions at the median and {p99} at the 99th percentile; {} and {} are allowed",
            BUDGET[0],
            BUDGET[1]
        );
        for (name, scans, dearest) in searches {
            ensure!(scans > 0, "{name}: no scan did");
            ensure!(
                dearest <= SEARCH_BUDGET,
                "{name}: a scan takes {dearest} instructions; {SEARCH_BUDGET} are allowed"
            );
        }
        check_assumed_cycles(self.pace.tally.cycles_per_instruction())
    }

    /// Prints what the cycles went into.
    fn print_causes(&self) {
        let tally = &self.pace.tally;
        let count = tally.of(Cause::Instructions) as f64;
        let causes = Cause::CYCLES
            .map(|cause| format!("{cause:?} {:.3}", tally.of(cause) as f64 / count).to_lowercase());
        println!(
            "cycles of an instruction: {:.3} ({}); {CYCLES_PER_INSTRUCTION} on the emulated board",
            tally.cycles_per_instruction(),
            causes.join(", ")
        );
    }

    /// Prints the loops counted by hand; returns those that cost something else.
    fn print_kernels(&self) -> anyhow::Result<Vec<&'static str>> {
        println!("\nloops, of each turn: instructions and cycles by hand, instructions and cycles counted");
        let mut wrong = Vec::new();
        for (name, instructions, cycles) in KERNELS {
            let counted = (self.instructions.turn(name)?, self.cycles.turn(name)?);
            println!("{name:<10} {instructions:>2} {cycles:>2}   {:>2} {:>2}", counted.0, counted.1);
            if counted != (instructions, cycles) {
                wrong.push(name);
            }
        }
        Ok(wrong)
    }
}

impl Run {
    /// Median, 99th percentile and maximum.
    pub fn percentiles(&self, of: impl Fn(&Counted) -> u32) -> [u32; 3] {
        percentiles(self.scans.iter().map(of))
    }
}

/// Median, 99th percentile and maximum; zeros of nothing.
fn percentiles(numbers: impl Iterator<Item = u32>) -> [u32; 3] {
    let mut all: Vec<u32> = numbers.collect();
    all.sort_unstable();
    let at = |share: f64| all.get(((all.len() as f64 * share) as usize).min(all.len().saturating_sub(1)));
    [0.5, 0.99, 1.0].map(|share| at(share).copied().unwrap_or(0))
}

fn cell([median, p99, max]: [u32; 3]) -> String {
    format!("{median} / {p99} / {max}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_the_firmware_says_is_taken_and_what_is_none_of_it_is_refused() {
        let mut measured = Measured::default();
        assert!(measured.take("scan [1, 2, 3, 4, 5, 6] 600 true 50 false").is_err(), "no run has begun");
        measured.take("run default 50").unwrap();
        measured.take("scan [1, 2, 3, 4, 5, 6] 600 true 51 false").unwrap();
        measured.take("scan [1, 2, 3, 4, 5, 7] 600 true 51 true").unwrap();
        measured.take("function sin 1262 22 0.0000001 0.002").unwrap();
        let sin = Function { name: "sin".to_owned(), instructions: [1262, 22], errors: [1e-7, 2e-3] };
        assert_eq!(measured.functions, [sin]);
        let scan = measured.runs[0].scans[0];
        assert_eq!((scan.total(), scan.points, scan.keyframe, scan.segments), (21, 600, true, 51));
        assert_eq!(measured.searches(false), [1, 22]);
        for bad in [
            "",
            "scan [1, 2] 600 true 51 false",
            "scan [1, 2, 3, 4, 5, 6] 600 true 51",
            "scan [1, 2, 3, 4, 5, x] 1 true 1 false",
            "run default",
            "walk 1",
            "function sin 1 2",
        ] {
            assert!(measured.take(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn percentiles_are_those_of_the_sorted_numbers() {
        assert_eq!(percentiles((1..=200).rev()), [101, 199, 200]);
        assert_eq!(percentiles(std::iter::empty()), [0; 3]);
    }
}
