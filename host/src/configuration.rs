//! The configurations by the names that the command line gives them.

use clap::ValueEnum;
use slam_core::SlamConfig;

/// Which algorithm a log is replayed with.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Configuration {
    /// The best we know.
    Default,
    /// The paper, literally.
    Paper,
    /// The paper, but the end points of a merge weigh as many points as they stand for.
    PaperWeighted,
    /// The same, and where a scan does not fix the whole pose, what it does fix is corrected.
    PaperPartial,
}

impl Configuration {
    /// Those of the paper, from its text to the default.
    pub const PAPERS: [Self; 3] = [Self::Paper, Self::PaperWeighted, Self::PaperPartial];

    /// As on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Default => "default",
            Self::Paper => "paper",
            Self::PaperWeighted => "paper-weighted",
            Self::PaperPartial => "paper-partial",
        }
    }

    /// For pictures.
    pub fn subtitle(self) -> &'static str {
        match self {
            Self::Default => "default configuration",
            Self::Paper => "paper configuration",
            Self::PaperWeighted => "paper configuration, weighted merge",
            Self::PaperPartial => "paper configuration, weighted merge, partial correction",
        }
    }

    /// All settings.
    pub fn config(self) -> SlamConfig {
        match self {
            Self::Default => SlamConfig::default(),
            Self::Paper => SlamConfig::paper(),
            Self::PaperWeighted => SlamConfig::paper_weighted(),
            Self::PaperPartial => SlamConfig::paper_partial(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_has_the_name_that_the_command_line_knows() {
        for configuration in Configuration::value_variants() {
            let named = configuration.to_possible_value().unwrap();
            assert_eq!(named.get_name(), configuration.name());
            assert!(configuration.config().validate().is_ok());
        }
    }
}
