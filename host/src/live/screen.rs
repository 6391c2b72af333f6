//! What the page shows, as text on a terminal: state, pose, what is wrong, and a small map.
//!
//! ```text
//! source ──► Event ──► Screen ──► draw ──► terminal
//! ```

use std::collections::{BTreeMap, VecDeque};
use std::io;
use std::time::Duration;

use ratatui::Frame;
use ratatui::crossterm::event::{self, Event as Input, KeyCode, KeyEventKind, KeyModifiers};
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::style::{Color, Modifier, Style};
use ratatui::symbols::Marker;
use ratatui::text::{Line as Text, Span};
use ratatui::widgets::canvas::{Canvas, Context, Line as Stroke, Points};
use ratatui::widgets::{Block, Paragraph, Wrap};
use slam_core::tracking::TrackingState;

use super::source::{About, Event, Line, Note, Pose, Source, Weight, What};
use super::status::Status;
use super::trail::Trail;

/// What happened last: so much is kept.
const NOTES: usize = 100;
/// Events and keys are waited for no longer than this between two pictures.
const PICTURE: Duration = Duration::from_millis(50);
/// Room around the map, metres.
const MARGIN_M: f64 = 0.5;
/// Width of what stands beside the map, and rows of what happened, frame included.
const FACTS_COLUMNS: u16 = 48;
const NOTES_ROWS: u16 = 7;
/// A character of braille is so many dots wide and high.
const DOTS: [f64; 2] = [2.0, 4.0];

/// What is known of the robot.
#[derive(Debug)]
pub struct Screen {
    about: About,
    stamp_us: u64,
    pose: Option<Pose>,
    status: Option<Status>,
    lines: BTreeMap<u32, Line>,
    trail: Trail,
    notes: VecDeque<(u64, Note)>,
}

/// Shows a source on the terminal until a key ends it, it is over, or the source has gone.
pub fn show(mut source: Source, is_over: impl Fn() -> bool) -> io::Result<()> {
    let mut screen = Screen::new(source.about.clone());
    let mut terminal = ratatui::try_init()?;
    let shown = (|| {
        // Not every terminal has another screen to begin with.
        terminal.clear()?;
        while !is_over() {
            loop {
                match source.try_next() {
                    Ok(Some(event)) => screen.take(event),
                    Ok(None) => break,
                    Err(_) => return Ok(()),
                }
            }
            terminal.draw(|frame| screen.draw(frame))?;
            if event::poll(PICTURE)? && ends(&event::read()?) {
                break;
            }
        }
        Ok(())
    })();
    ratatui::try_restore()?;
    shown
}

/// Ctrl-C is a key while a terminal is read key by key.
fn ends(input: &Input) -> bool {
    let Input::Key(key) = input else { return false };
    let is_interrupt = key.code == KeyCode::Char('c') && key.modifiers.contains(KeyModifiers::CONTROL);
    key.kind == KeyEventKind::Press && (is_interrupt || matches!(key.code, KeyCode::Char('q') | KeyCode::Esc))
}

impl Screen {
    /// Of a source of which nothing has been heard yet.
    pub fn new(about: About) -> Self {
        Self {
            about,
            stamp_us: 0,
            pose: None,
            status: None,
            lines: BTreeMap::new(),
            trail: Trail::default(),
            notes: VecDeque::new(),
        }
    }

    /// Takes in what happened.
    pub fn take(&mut self, event: Event) {
        self.stamp_us = event.stamp_us;
        match event.what {
            What::Pose(pose) => {
                self.trail.push([pose.at[0], pose.at[1]]);
                self.pose = Some(pose);
            }
            What::Lines { changed, removed } => {
                self.lines.extend(changed.into_iter().map(|line| (line.id, line)));
                self.lines.retain(|id, _| !removed.contains(id));
            }
            What::Path(points) => self.trail.replace(points.iter().map(|point| point.at)),
            What::Began | What::Forgotten => {
                self.lines.clear();
                self.trail = Trail::default();
            }
            What::Status(status) => self.status = Some(*status),
            What::Note(note) => {
                self.notes.push_front((event.stamp_us, note));
                self.notes.truncate(NOTES);
            }
            What::Scan(_) | What::Places(_) | What::Playback(_) => {}
        }
    }

    /// Draws it, in whatever room there is.
    pub fn draw(&self, frame: &mut Frame) {
        let [top, middle, notes, keys] = Layout::vertical([
            Constraint::Length(1),
            Constraint::Min(0),
            Constraint::Length(NOTES_ROWS),
            Constraint::Length(1),
        ])
        .areas(frame.area());
        let [map, facts] =
            Layout::horizontal([Constraint::Min(0), Constraint::Length(FACTS_COLUMNS)]).areas(middle);
        frame.render_widget(
            Text::from(vec![
                Span::styled(self.about.title.as_str(), Modifier::BOLD),
                Span::raw("  "),
                Span::raw(self.about.subtitle.as_str()),
            ]),
            top,
        );
        self.draw_map(frame, map);
        frame.render_widget(
            Paragraph::new(self.facts()).wrap(Wrap { trim: false }).block(Block::bordered().title("Robot")),
            facts,
        );
        frame.render_widget(
            Paragraph::new(self.notes()).block(Block::bordered().title("What happened")),
            notes,
        );
        frame.render_widget(Text::styled("q ends", Modifier::DIM), keys);
    }

    fn draw_map(&self, frame: &mut Frame, area: Rect) {
        let block = Block::bordered();
        let inner = block.inner(area);
        let dots = [f64::from(inner.width) * DOTS[0], f64::from(inner.height) * DOTS[1]];
        let [x, y] = self.bounds(dots);
        let title =
            if self.pose.is_some() { format!("Map, {:.0} m wide", x[1] - x[0]) } else { "Map".into() };
        let canvas = Canvas::default()
            .block(block.title(title))
            .marker(Marker::Braille)
            .x_bounds(x)
            .y_bounds(y)
            .paint(|context| self.paint(context, (x[1] - x[0]) / dots[0].max(1.0)));
        frame.render_widget(canvas, area);
    }

    fn paint(&self, context: &mut Context, dot_m: f64) {
        let trail: Vec<(f64, f64)> =
            self.trail.points().iter().map(|[x, y]| (f64::from(*x), f64::from(*y))).collect();
        context.draw(&Points { coords: &trail, color: Color::Red });
        context.layer();
        for (walls, color) in [(false, Color::DarkGray), (true, Color::Blue)] {
            for line in self.lines.values().filter(|line| line.wall == walls) {
                let [x1, y1, x2, y2] = line.ends.map(f64::from);
                context.draw(&Stroke { x1, y1, x2, y2, color });
            }
        }
        if let Some(pose) = &self.pose {
            context.layer();
            let [x, y, heading] = pose.at.map(f64::from);
            let ahead = 6.0 * dot_m;
            let (x2, y2) = (x + ahead * heading.cos(), y + ahead * heading.sin());
            context.draw(&Stroke { x1: x, y1: y, x2, y2, color: color_of(pose.state) });
        }
    }

    /// Of the map in x and y, as wide and high as the dots that there are, so that a right angle is one.
    fn bounds(&self, dots: [f64; 2]) -> [[f64; 2]; 2] {
        let ends =
            self.lines.values().flat_map(|line| [[line.ends[0], line.ends[1]], [line.ends[2], line.ends[3]]]);
        let points = ends.chain(self.trail.points().iter().copied());
        let mut bounds = [[0.0f64; 2]; 2];
        for (axis, bounds) in bounds.iter_mut().enumerate() {
            let along = points.clone().map(|point| f64::from(point[axis]));
            let (least, most) =
                along.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)));
            *bounds = if least <= most { [least - MARGIN_M, most + MARGIN_M] } else { [-MARGIN_M, MARGIN_M] };
        }
        let dot_m = bounds.iter().zip(dots).map(|([a, b], dots)| (b - a) / dots.max(1.0)).fold(0.0, f64::max);
        std::array::from_fn(|axis| {
            let [least, most] = bounds[axis];
            let (middle, half) = (0.5 * (least + most), 0.5 * dot_m * dots[axis].max(1.0));
            [middle - half, middle + half]
        })
    }

    fn facts(&self) -> Vec<Text<'_>> {
        let Some(pose) = &self.pose else { return vec!["Nothing has been heard of it yet.".into()] };
        let [x, y, heading] = pose.at;
        let [xx, _, _, yy, _, turn] = pose.covariance.map(|v| v.max(0.0));
        let mut facts = vec![
            Text::styled(
                pose.state.name(),
                Style::new().fg(color_of(pose.state)).add_modifier(Modifier::BOLD),
            ),
            fact("x, y", format!("{x:.3}, {y:.3} ± {:.3} m", (xx + yy).sqrt())),
            fact("Heading", format!("{:.1} ± {:.2}°", heading.to_degrees(), turn.sqrt().to_degrees())),
        ];
        let Some(status) = &self.status else { return facts };
        facts.extend(status.facts().into_iter().map(|each| fact(each.name, each.value)));
        let losses = status.more.iter().filter(|counter| counter.count > 0);
        facts.extend(losses.map(|counter| fact(counter.name, counter.count.to_string())));
        for trouble in status.troubles() {
            facts.push(Text::styled(trouble.what, color_of_weight(trouble.weight)));
            facts.push(Text::raw(trouble.remedy));
        }
        facts
    }

    fn notes(&self) -> Vec<Text<'_>> {
        let notes = self.notes.iter().map(|(stamp_us, note)| {
            let at = format!("{:9.1} s  ", *stamp_us as f64 * 1e-6);
            vec![Span::raw(at), Span::styled(note.text.as_ref(), color_of_weight(note.weight))].into()
        });
        notes.collect()
    }
}

fn fact(name: &'static str, value: String) -> Text<'static> {
    vec![Span::styled(format!("{name:<21}"), Modifier::DIM), Span::raw(value)].into()
}

fn color_of(state: TrackingState) -> Color {
    match state {
        TrackingState::Tracking => Color::Green,
        TrackingState::Uncertain => Color::Yellow,
        TrackingState::Lost => Color::Red,
    }
}

fn color_of_weight(weight: Weight) -> Color {
    match weight {
        Weight::Info => Color::Reset,
        Weight::Warning => Color::Yellow,
        Weight::Error => Color::Red,
    }
}

#[cfg(test)]
mod tests {
    use ratatui::Terminal;
    use ratatui::backend::TestBackend;

    use super::super::source::Kind;
    use super::super::status::tests::well;
    use super::*;

    fn screen() -> Screen {
        Screen::new(About {
            title: "/dev/ttyACM0".into(),
            subtitle: "robot 'paper', lineslam 0.1.0 on nucleo".into(),
            kind: Kind::Robot,
            base_from_laser: [0.0; 3],
            blueprint: Vec::new(),
            paced: false,
        })
    }

    fn drawn(screen: &Screen, columns: u16, rows: u16) -> String {
        let mut terminal = Terminal::new(TestBackend::new(columns, rows)).unwrap();
        terminal.draw(|frame| screen.draw(frame)).unwrap();
        terminal.backend().to_string()
    }

    fn driven(state: TrackingState) -> Screen {
        let mut screen = screen();
        let mut take = |stamp_us, what| screen.take(Event { stamp_us, what });
        let wall = |id, ends| Line { id, ends, hits: 9, wall: true };
        for step in 0..20u64 {
            let at = [step as f32 * 0.1, 0.5, 0.25];
            take(
                step * 100_000,
                What::Pose(Pose { at, covariance: [0.0004, 0.0, 0.0, 0.0005, 0.0, 0.0], state }),
            );
        }
        let changed =
            vec![wall(1, [-1.0, -1.0, 9.0, -1.0]), wall(2, [9.0, -1.0, 9.0, 4.0]), wall(3, [0.0; 4])];
        take(2_000_000, What::Lines { changed, removed: vec![3] });
        take(2_000_000, What::Status(Box::new(Status { state, ..well() })));
        take(2_500_000, What::Note(Note::new(Weight::Info, "A loop was closed.")));
        screen
    }

    #[test]
    fn pose_facts_map_and_what_happened_are_there() {
        let text = drawn(&driven(TrackingState::Tracking), 120, 40);
        for said in [
            "/dev/ttyACM0  robot 'paper', lineslam 0.1.0 on nucleo",
            "tracking",
            "1.900, 0.500 ± 0.030 m",
            "14.3 ± 0.00°",
            "37 of 512",
            "2.5 s  A loop was closed.",
            "q ends",
        ] {
            assert!(text.contains(said), "{said}:\n{text}");
        }
        let dots = text.chars().filter(|c| ('\u{2801}'..='\u{28ff}').contains(c)).count();
        assert!(dots > 80, "{dots} characters of the map:\n{text}");
    }

    #[test]
    fn what_is_wrong_is_said_with_what_to_do() {
        let text = drawn(&driven(TrackingState::Lost), 120, 40);
        assert!(text.contains("lost") && text.contains("does not know where it is"), "{text}");
        assert!(text.contains("looks for itself"), "{text}");
    }

    #[test]
    fn a_right_angle_is_one_in_any_window() {
        for dots in [[152.0, 124.0], [20.0, 300.0], [400.0, 8.0]] {
            let [x, y] = driven(TrackingState::Tracking).bounds(dots);
            assert!(((x[1] - x[0]) / dots[0] - (y[1] - y[0]) / dots[1]).abs() < 1e-9);
            assert!(x[0] <= -1.0 && x[1] >= 9.0 && y[0] <= -1.0 && y[1] >= 4.0);
        }
    }

    #[test]
    fn no_room_and_no_robot_are_borne() {
        for (columns, rows) in [(1, 1), (10, 3), (44, 9), (300, 2)] {
            drawn(&driven(TrackingState::Tracking), columns, rows);
            drawn(&screen(), columns, rows);
        }
        assert!(drawn(&screen(), 120, 40).contains("Nothing has been heard of it yet."));
        let mut forgotten = driven(TrackingState::Tracking);
        forgotten.take(Event { stamp_us: 3_000_000, what: What::Forgotten });
        assert!(forgotten.lines.is_empty() && forgotten.trail.points().is_empty());
    }
}
