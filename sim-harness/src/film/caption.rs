//! Captions around a picture: above, the instruction; below, control step and plan, the sub-tasks, and the plans as a strip of colours
//! along the episode. What can fail: nothing; text that does not fit ends in "...".

use embedded_graphics::Drawable;
use embedded_graphics::geometry::{Point, Size};
use embedded_graphics::mono_font::iso_8859_1::{FONT_8X13, FONT_10X20};
use embedded_graphics::mono_font::{MonoFont, MonoTextStyle};
use embedded_graphics::pixelcolor::{Rgb888, RgbColor as _};
use embedded_graphics::primitives::{Primitive as _, PrimitiveStyle, Rectangle};
use embedded_graphics::text::{Alignment, Baseline, Text, TextStyleBuilder};

use super::canvas::Canvas;
use crate::environment::Completion;
use crate::rollout::Phase;

/// Height of the caption above the picture, in pixels.
pub const HEAD: u32 = 48;
/// Height of the caption below the picture, in pixels.
pub const FOOT: u32 = 80;

/// Height of a line that [`line()`] writes.
pub const LINE_HEIGHT: u32 = 18;

const MARGIN: i32 = 8;
const HEAD_LINES: usize = 2;
const LINE: i32 = LINE_HEIGHT as i32;
const STRIP: u32 = 10;

const PAPER: Rgb888 = Rgb888::new(22, 24, 29);
const INK: Rgb888 = Rgb888::new(240, 240, 240);
const FAINT: Rgb888 = Rgb888::new(130, 134, 142);
const DONE: Rgb888 = Rgb888::new(80, 200, 120);
/// Colour of sub-tasks that were completed without having been commanded.
const UNASKED: Rgb888 = Rgb888::new(240, 150, 60);
/// Colours of plans, by Okabe and Ito; plans share them in turn.
const PLANS: [Rgb888; 7] = [
    Rgb888::new(86, 180, 233),
    Rgb888::new(230, 159, 0),
    Rgb888::new(0, 158, 115),
    Rgb888::new(240, 228, 66),
    Rgb888::new(0, 114, 178),
    Rgb888::new(213, 94, 0),
    Rgb888::new(204, 121, 167),
];

/// All colours that captions use.
pub fn colors() -> impl Iterator<Item = [u8; 3]> {
    let own = [PAPER, INK, FAINT, DONE, UNASKED];
    let all = own.into_iter().chain(PLANS);
    all.map(|color| [color.r(), color.g(), color.b()])
}

/// Texts and sizes of the captions of an episode.
pub struct Caption<'c> {
    /// Text of the instruction.
    pub instruction: &'c str,
    /// Names of all sub-tasks.
    pub sub_tasks: &'c [&'static str],
    /// Indices of the sub-tasks that the instruction commands.
    pub commanded: &'c [usize],
    /// Number of control steps in all: the width of the strip.
    pub steps: usize,
    /// Control period in seconds.
    pub period_s: f64,
    /// Note beside the status.
    pub note: &'c str,
}

/// Progress of an episode at one of its states.
#[derive(Debug, Clone, Copy)]
pub struct Progress<'p> {
    /// Plan of every control step that was executed, where there is one.
    pub plans: &'p [Option<u32>],
    /// Completions so far.
    pub completions: &'p [Completion],
    /// Phase of the episode: what comes next.
    pub phase: Phase,
}

/// Writes a line across the picture whose upper edge is at `top`.
pub fn line(text: &str, top: u32, canvas: &mut Canvas) {
    let corner = Point::new(0, top as i32);
    fill(canvas, corner, [canvas.size()[0], LINE_HEIGHT], PAPER);
    write(
        canvas,
        &FONT_8X13,
        FAINT,
        Point::new(MARGIN, top as i32 + 2),
        text,
    );
}

/// A sub-task's text and colour in its present state.
struct Mark {
    text: String,
    color: Rgb888,
    done: bool,
}

impl Caption<'_> {
    /// Draws all captions around the picture, down to `bottom`.
    pub fn draw(&self, progress: Progress<'_>, bottom: u32, canvas: &mut Canvas) {
        let [width, _] = canvas.size();
        let foot = bottom.saturating_sub(FOOT);
        fill(canvas, Point::zero(), [width, HEAD], PAPER);
        fill(canvas, Point::new(0, foot as i32), [width, FOOT], PAPER);
        let columns = (width as i32 - 2 * MARGIN) / FONT_10X20.character_size.width as i32;
        let lines = wrap(self.instruction, columns as usize, HEAD_LINES);
        for (y, line) in (4..).step_by(20).zip(&lines) {
            write(canvas, &FONT_10X20, INK, Point::new(MARGIN, y), line);
        }
        let mut top = foot as i32 + 5;
        self.status(progress, top, canvas);
        top += LINE;
        let strip = bottom.saturating_sub(STRIP);
        self.marks(progress, top, strip, canvas);
        self.strip(progress, strip, canvas);
    }

    fn status(&self, progress: Progress<'_>, top: i32, canvas: &mut Canvas) {
        let (number, all) = (progress.plans.len(), self.steps);
        let at = number as f64 * self.period_s;
        let state = match progress.phase {
            Phase::Acting { plan } => {
                plan.map_or_else(String::new, |plan| format!("plan {plan:>3}"))
            }
            Phase::Ended { .. } if self.commanded.is_empty() => "ended".to_owned(),
            Phase::Ended { success: true } => "carried out".to_owned(),
            Phase::Ended { success: false } => "not carried out".to_owned(),
        };
        let text = format!("step {number:>3} of {all}  {at:>5.2} s  {state}");
        write(canvas, &FONT_8X13, INK, Point::new(MARGIN, top), &text);
        if let Phase::Acting { plan: Some(plan) } = progress.phase {
            let x = MARGIN + FONT_8X13.character_size.width as i32 * (text.len() as i32 + 1);
            fill(canvas, Point::new(x, top + 1), [11, 11], plan_color(plan));
        }
        if !self.note.is_empty() {
            let right = Point::new(canvas.size()[0] as i32 - MARGIN, top);
            let style = TextStyleBuilder::new()
                .baseline(Baseline::Top)
                .alignment(Alignment::Right)
                .build();
            let ink = MonoTextStyle::new(&FONT_8X13, FAINT);
            let Ok(_) = Text::with_text_style(self.note, right, ink, style).draw(canvas);
        }
    }

    /// Draws the sub-tasks, commanded ones first, in as many rows as there are.
    fn marks(&self, progress: Progress<'_>, mut top: i32, strip: u32, canvas: &mut Canvas) {
        let [width, _] = canvas.size();
        let mut left = MARGIN;
        for mark in self.list(progress.completions) {
            let character = FONT_8X13.character_size.width as i32;
            let needed = 16 + character * mark.text.chars().count() as i32;
            if left > MARGIN && left + needed > width as i32 - MARGIN {
                (left, top) = (MARGIN, top + LINE);
            }
            if top + LINE > strip as i32 {
                break;
            }
            let corner = Point::new(left, top + 1);
            fill(canvas, corner, [11, 11], mark.color);
            if !mark.done {
                fill(canvas, corner + Point::new(1, 1), [9, 9], PAPER);
            }
            write(
                canvas,
                &FONT_8X13,
                mark.color,
                Point::new(left + 16, top),
                &mark.text,
            );
            left += needed + 2 * character;
        }
    }

    fn list(&self, completions: &[Completion]) -> Vec<Mark> {
        let name = |sub_task: usize| self.sub_tasks.get(sub_task).copied().unwrap_or("?");
        let done = completions.iter();
        let asked = self.commanded.iter().map(|&sub_task| {
            let done = done.clone().find(|done| done.sub_task == sub_task);
            let text = done.map_or(name(sub_task).to_owned(), |done| {
                format!("{} @{}", name(sub_task), done.step)
            });
            Mark {
                text,
                color: if done.is_some() { DONE } else { FAINT },
                done: done.is_some(),
            }
        });
        let unasked = done
            .clone()
            .filter(|done| !self.commanded.contains(&done.sub_task));
        let unasked = unasked.map(|done| Mark {
            text: format!("{} @{} (not asked)", name(done.sub_task), done.step),
            color: UNASKED,
            done: true,
        });
        asked.chain(unasked).collect()
    }

    /// Draws the plan in force at each step so far, as a colour, and completions as white lines.
    fn strip(&self, progress: Progress<'_>, top: u32, canvas: &mut Canvas) {
        let width = canvas.size()[0];
        let all = self.steps.max(1);
        let x = |step: usize| (step as u64 * u64::from(width) / all as u64) as u32;
        for (step, &plan) in progress.plans.iter().enumerate() {
            let Some(plan) = plan else {
                continue;
            };
            let corner = Point::new(x(step) as i32, top as i32);
            let size = [x(step + 1) - x(step), STRIP];
            fill(canvas, corner, size, plan_color(plan));
        }
        for done in progress.completions {
            let corner = Point::new(x(done.step) as i32 - 2, top as i32);
            fill(canvas, corner, [2, STRIP], INK);
        }
    }
}

/// Colour of a plan in pictures; plans share the few colours that stay apart for most eyes.
fn plan_color(plan: u32) -> Rgb888 {
    PLANS[plan as usize % PLANS.len()]
}

fn fill(canvas: &mut Canvas, corner: Point, [width, height]: [u32; 2], color: Rgb888) {
    let area = Rectangle::new(corner, Size::new(width, height));
    let Ok(()) = area
        .into_styled(PrimitiveStyle::with_fill(color))
        .draw(canvas);
}

fn write(canvas: &mut Canvas, font: &MonoFont<'_>, color: Rgb888, at: Point, text: &str) {
    let style = MonoTextStyle::new(font, color);
    let Ok(_) = Text::with_baseline(text, at, style, Baseline::Top).draw(canvas);
}

/// Breaks text at spaces into lines of at most `columns` characters; what does not fit into `lines` of them ends in "...".
fn wrap(text: &str, columns: usize, lines: usize) -> Vec<String> {
    let mut wrapped = vec![String::new()];
    for word in text.split_whitespace() {
        let last = wrapped.last().map_or(0, |line| line.chars().count());
        if last > 0 && last + 1 + word.chars().count() > columns {
            wrapped.push(String::new());
        }
        if let Some(line) = wrapped.last_mut() {
            if !line.is_empty() {
                line.push(' ');
            }
            line.push_str(word);
        }
    }
    let cut = wrapped.len() > lines;
    wrapped.truncate(lines);
    let last = wrapped.len() - 1;
    for (number, line) in wrapped.iter_mut().enumerate() {
        if line.chars().count() > columns || (cut && number == last) {
            *line = line.chars().take(columns.saturating_sub(3)).collect();
            line.push_str("...");
        }
    }
    wrapped
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_break_at_spaces_and_long_texts_are_cut() {
        assert_eq!(wrap("open the drawer", 8, 2), ["open the", "drawer"]);
        assert_eq!(
            wrap("open the drawer slowly", 8, 2),
            ["open the", "drawe..."]
        );
        assert_eq!(wrap("incomprehensible", 8, 2), ["incom..."]);
        assert_eq!(wrap("", 8, 2), [""]);
    }
}
