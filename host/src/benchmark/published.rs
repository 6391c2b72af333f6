//! What others publish on the logs of the benchmark, to the digits that they give.

/// What a figure measures.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Measure {
    /// Absolute trajectory error, rmse, metres.
    Trajectory,
    /// Relations between poses: translation, mean and standard deviation, metres.
    Relations,
    /// The same: rotation, degrees.
    RelationsRotation,
    /// Thickness of the walls of the reference's map, median, metres.
    ReferenceWalls,
}

/// A figure of somebody else's.
#[derive(Clone, Copy, Debug)]
pub struct Published {
    /// Name of the log.
    pub log: &'static str,
    /// What was measured.
    pub measure: Measure,
    /// Of which method.
    pub method: &'static str,
    /// The figure as it is printed there.
    pub figure: &'static str,
    /// Where.
    pub source: &'static str,
}

/// The README beside the logs with references.
pub const README: &str = "README of the logs with references";
/// Hess et al.
pub const HESS: &str = "Hess et al. 2016, tables II and III";
/// Kümmerle et al.
pub const KUEMMERLE: &str = "Kümmerle et al. 2009";
/// Sparse-gslam.
pub const SPARSE: &str = "sparse-gslam, IROS 2022, table I";
/// Computed, not published in a paper.
pub const FROM_LOGS: &str = "computed from the logs, README of the logs with references";

const fn trajectory(method: &'static str, log: &'static str, figure: &'static str) -> Published {
    Published { log, measure: Measure::Trajectory, method, figure, source: README }
}

const fn relations(
    method: &'static str,
    source: &'static str,
    log: &'static str,
    figure: &'static str,
) -> Published {
    Published { log, measure: Measure::Relations, method, figure, source }
}

const fn rotation(log: &'static str, figure: &'static str) -> Published {
    Published { log, measure: Measure::RelationsRotation, method: CARTOGRAPHER, figure, source: HESS }
}

const fn thickness(log: &'static str, figure: &'static str) -> Published {
    let method = "reference";
    Published { log, measure: Measure::ReferenceWalls, method, figure, source: README }
}

const DEAD_RECKONING: &str = "dead reckoning";
const BREEZY: &str = "BreezySLAM RMHC";
const CSM: &str = "CSM PLICP, scan to scan";
const KISS: &str = "KISS-ICP + odometry";
const HECTOR: &str = "hector + odometry";
const KARTO: &str = "karto, loops closed";
const GMAPPING: &str = "GMapping, 30 particles, final";
const ODOMETRY: &str = "odometry";
const MATCHING: &str = "scan matching";
const RBPF: &str = "RBPF, 50 particles";
const GRAPH: &str = "graph mapping";
const CARTOGRAPHER: &str = "Cartographer";
const GSLAM: &str = "sparse-gslam (line segments, 11 beams)";

/// All figures, method by method.
pub const PUBLISHED: &[Published] = &[
    trajectory(DEAD_RECKONING, "exp1", "0.833"),
    trajectory(DEAD_RECKONING, "csail", "8.67"),
    trajectory(DEAD_RECKONING, "fr079", "11.9"),
    trajectory(DEAD_RECKONING, "fr101", "10.6"),
    trajectory(DEAD_RECKONING, "seattle", "27.8"),
    trajectory(BREEZY, "exp1", "1.130"),
    trajectory(BREEZY, "fr079", "4.05"),
    trajectory(CSM, "exp1", "0.623"),
    trajectory(CSM, "csail", "23.4"),
    trajectory(CSM, "fr079", "1.24"),
    trajectory(CSM, "fr101", "0.171"),
    trajectory(CSM, "seattle", "0.271"),
    trajectory(KISS, "exp1", "0.267"),
    trajectory(KISS, "csail", "9.19"),
    trajectory(KISS, "fr079", "0.174"),
    trajectory(KISS, "fr101", "0.073"),
    trajectory(KISS, "seattle", "1.27"),
    trajectory(HECTOR, "exp1", "3.89"),
    trajectory(HECTOR, "csail", "7.34"),
    trajectory(HECTOR, "fr079", "0.077"),
    trajectory(HECTOR, "fr101", "0.650"),
    trajectory(HECTOR, "seattle", "0.057"),
    trajectory(KARTO, "exp1", "0.683"),
    trajectory(KARTO, "csail", "0.158"),
    trajectory(KARTO, "fr079", "1.25"),
    trajectory(KARTO, "fr101", "0.055"),
    trajectory(KARTO, "seattle", "0.069"),
    trajectory(GMAPPING, "exp1", "0.400 (0.211 with the lag fixed)"),
    trajectory(GMAPPING, "csail", "0.176"),
    trajectory(GMAPPING, "fr079", "0.065"),
    trajectory(GMAPPING, "fr101", "0.040"),
    trajectory(GMAPPING, "seattle", "0.065"),
    thickness("exp1", "0.039"),
    thickness("csail", "0.029"),
    thickness("fr079", "0.054"),
    thickness("fr101", "0.034"),
    thickness("seattle", "0.016"),
    relations(ODOMETRY, FROM_LOGS, "aces", "0.549 ± 2.681"),
    relations(ODOMETRY, FROM_LOGS, "intel", "7.378 ± 14.345"),
    relations(ODOMETRY, FROM_LOGS, "mit-killian", "50.3 ± 128.1"),
    relations(ODOMETRY, FROM_LOGS, "mit-csail", "1.681 ± 5.292"),
    relations(ODOMETRY, FROM_LOGS, "fr079", "6.504 ± 13.664"),
    relations(ODOMETRY, FROM_LOGS, "hospital", "0.615 ± 2.532"),
    relations(MATCHING, KUEMMERLE, "aces", "0.173 ± 0.614"),
    relations(MATCHING, KUEMMERLE, "intel", "0.220 ± 0.296"),
    relations(MATCHING, KUEMMERLE, "mit-killian", "1.651 ± 4.138"),
    relations(MATCHING, KUEMMERLE, "mit-csail", "0.106 ± 0.325"),
    relations(MATCHING, KUEMMERLE, "fr079", "0.258 ± 0.427"),
    relations(MATCHING, KUEMMERLE, "hospital", "0.434 ± 1.615"),
    relations(RBPF, KUEMMERLE, "aces", "0.060 ± 0.049"),
    relations(RBPF, KUEMMERLE, "intel", "0.070 ± 0.083"),
    relations(RBPF, KUEMMERLE, "mit-killian", "0.122 ± 0.386"),
    relations(RBPF, KUEMMERLE, "mit-csail", "0.049 ± 0.049"),
    relations(RBPF, KUEMMERLE, "fr079", "0.061 ± 0.044"),
    relations(RBPF, KUEMMERLE, "hospital", "0.637 ± 2.638"),
    relations(GRAPH, HESS, "aces", "0.044 ± 0.044"),
    relations(GRAPH, HESS, "intel", "0.031 ± 0.026"),
    relations(GRAPH, HESS, "mit-killian", "0.050 ± 0.056"),
    relations(GRAPH, HESS, "mit-csail", "0.004 ± 0.009"),
    relations(GRAPH, HESS, "fr079", "0.056 ± 0.042"),
    relations(GRAPH, HESS, "hospital", "0.143 ± 0.180"),
    relations(CARTOGRAPHER, HESS, "aces", "0.0375 ± 0.0426"),
    relations(CARTOGRAPHER, HESS, "intel", "0.0229 ± 0.0239"),
    relations(CARTOGRAPHER, HESS, "mit-killian", "0.0395 ± 0.0488"),
    relations(CARTOGRAPHER, HESS, "mit-csail", "0.0319 ± 0.0363"),
    relations(CARTOGRAPHER, HESS, "fr079", "0.0452 ± 0.0354"),
    relations(CARTOGRAPHER, HESS, "hospital", "0.1078 ± 0.1943"),
    rotation("aces", "0.373 ± 0.469"),
    rotation("intel", "0.453 ± 1.335"),
    rotation("mit-killian", "0.352 ± 0.353"),
    rotation("mit-csail", "0.369 ± 0.365"),
    rotation("fr079", "0.538 ± 0.718"),
    rotation("hospital", "0.747 ± 2.047"),
    relations(GSLAM, SPARSE, "aces", "0.0455 ± 0.0492"),
    relations(GSLAM, SPARSE, "intel", "0.0848 ± 0.1151"),
    relations(GSLAM, SPARSE, "mit-killian", "0.0718 ± 0.1913"),
];

/// The figures of a measure on a log.
pub fn on(log: &str, measure: Measure) -> impl Iterator<Item = &'static Published> + Clone {
    let log = PUBLISHED.iter().map(|p| p.log).find(|name| *name == log);
    PUBLISHED.iter().filter(move |p| Some(p.log) == log && p.measure == measure)
}

/// The methods of a measure, each once, in the table's order.
pub fn methods(measure: Measure) -> Vec<(&'static str, &'static str)> {
    let mut methods: Vec<(&str, &str)> =
        PUBLISHED.iter().filter(|p| p.measure == measure).map(|p| (p.method, p.source)).collect();
    methods.dedup();
    methods
}

/// Published works, in the order of the list.
pub(super) const SOURCES: [(&str, &str); 4] = [
    (
        README,
        "The README beside the logs with references, which are not public as files: the results of others' programs on them, by the \
         same score. What they were made from is in the repositories above",
    ),
    (
        KUEMMERLE,
        "Kümmerle, Steder, Dornhege, Ruhnke, Grisetti, Stachniss, Kleiner: On measuring the accuracy of SLAM algorithms. \
         Autonomous Robots 27, 2009. Relations, and the figures of scan matching and RBPF",
    ),
    (
        HESS,
        "Hess, Kohler, Rapp, Andor: Real-time loop closure in 2D LIDAR SLAM. ICRA 2016, tables II and III. Cartographer, graph \
         mapping; the latter made the reference of mit-csail",
    ),
    (SPARSE, "sparse-gslam, IROS 2022, table I. Line segments from 11 beams a scan"),
];

/// Its number in the list of the page.
pub(super) fn source_number(source: &str) -> usize {
    let source = if source == FROM_LOGS { README } else { source };
    SOURCES.iter().position(|(s, _)| *s == source).map_or(0, |k| k + 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_figure_stands_once() {
        for (k, a) in PUBLISHED.iter().enumerate() {
            let same = |b: &&Published| (a.log, a.measure, a.method) == (b.log, b.measure, b.method);
            assert!(!PUBLISHED[k + 1..].iter().any(|b| same(&b)), "{a:?}");
        }
        assert_eq!(methods(Measure::Trajectory).len(), 7);
        assert_eq!(methods(Measure::Relations).len(), 6);
        assert_eq!(on("fr079", Measure::Trajectory).count(), 7);
        assert_eq!(on("hospital", Measure::Relations).count(), 5);
        assert_eq!(on("nowhere", Measure::Relations).count(), 0);
    }
}
