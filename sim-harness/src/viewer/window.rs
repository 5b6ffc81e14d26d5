//! The viewer's window: pictures into it, mouse and keys out of it. What can fail: the display, and drawing.

use std::num::NonZeroU32;
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use softbuffer::{Context, Surface};
use winit::application::ApplicationHandler;
use winit::dpi::{LogicalSize, PhysicalPosition, PhysicalSize};
use winit::event::{ElementState, MouseButton, MouseScrollDelta, StartCause, WindowEvent};
use winit::event_loop::{ActiveEventLoop, ControlFlow, OwnedDisplayHandle};
use winit::keyboard::{Key, ModifiersState, NamedKey};
use winit::window::{Window, WindowId};

use super::show::{self, Show};
use super::{Texts, ViewerError, no_window, quietly};
use crate::film::camera::{Camera, Motion};
use crate::film::canvas::Canvas;
use crate::film::caption::{self, Caption, Progress};

/// Initial and smallest width and height of the window's inside.
pub const SIZE: [u32; 2] = [
    800,
    caption::HEAD + 540 + caption::FOOT + caption::LINE_HEIGHT,
];
const LEAST: [u32; 2] = [480, 400];
/// Time that a window must keep its size before the camera follows, which is slow.
const SETTLED: Duration = Duration::from_millis(200);
/// Share of the picture's height that a notch of the wheel zooms by, and that a pixel of a touch pad does.
const NOTCH: f64 = 0.05;
const TOUCH: f64 = 0.002;

const HELP: &str = "drag: turn, right: shift, wheel: zoom | space: pause | .: step | + -: speed | r: again | q: quit";

type Pixels = Surface<OwnedDisplayHandle, Rc<Window>>;

/// Size of the picture inside a canvas of `width` by `height` pixels.
pub fn picture([width, height]: [u32; 2]) -> [u32; 2] {
    let around = caption::HEAD + caption::FOOT + caption::LINE_HEIGHT;
    [width.max(1), height.saturating_sub(around).max(1)]
}

/// Handler of the window's events.
pub struct Screen<'s> {
    show: &'s Show<'s>,
    texts: &'s Texts,
    camera: Camera,
    canvas: Canvas,
    opened: Option<(Rc<Window>, Pixels)>,
    mouse: Mouse,
    /// Size of the window's inside, as last reported; a window that is just being destroyed cannot be asked.
    size: PhysicalSize<u32>,
    resized: Option<Instant>,
    title: String,
    done: Arc<AtomicBool>,
    failed: Option<ViewerError>,
}

/// Position of the mouse, and its pressed button.
#[derive(Default)]
struct Mouse {
    at: PhysicalPosition<f64>,
    pressed: Option<MouseButton>,
    keys: ModifiersState,
}

impl Mouse {
    fn motion(&self) -> Option<Motion> {
        match self.pressed? {
            MouseButton::Left => Some(Motion::Turn),
            MouseButton::Right if self.keys.shift_key() => Some(Motion::Glide),
            MouseButton::Right => Some(Motion::Shift),
            MouseButton::Middle => Some(Motion::Zoom),
            _ => None,
        }
    }
}

impl<'s> Screen<'s> {
    /// Prepares a window that shows what `camera` sees.
    pub fn new(show: &'s Show<'s>, camera: Camera, texts: &'s Texts) -> Self {
        Self {
            show,
            texts,
            camera,
            canvas: Canvas::new(SIZE[0], SIZE[1]),
            opened: None,
            mouse: Mouse::default(),
            size: PhysicalSize::default(),
            resized: None,
            title: String::new(),
            done: Arc::default(),
            failed: None,
        }
    }

    /// Flag to raise, before waking the window, when the work has ended.
    pub fn done(&self) -> Arc<AtomicBool> {
        Arc::clone(&self.done)
    }

    /// Returns why the window closed by itself, if it did.
    pub fn failed(self) -> Option<ViewerError> {
        self.failed
    }

    fn open(&mut self, events: &ActiveEventLoop) -> Result<(), ViewerError> {
        let size = |[width, height]: [u32; 2]| LogicalSize::new(width, height);
        let attributes = Window::default_attributes()
            .with_title("lads")
            .with_inner_size(size(SIZE))
            .with_min_inner_size(size(LEAST));
        let window = quietly(|| events.create_window(attributes))?.map_err(no_window)?;
        self.size = window.inner_size();
        let window = Rc::new(window);
        let context = Context::new(events.owned_display_handle()).map_err(no_window)?;
        let pixels = Surface::new(&context, Rc::clone(&window)).map_err(no_window)?;
        self.opened = Some((window, pixels));
        Ok(())
    }

    /// Draws the shown state into the window.
    fn draw(&mut self) -> Result<(), ViewerError> {
        let Some((window, pixels)) = &mut self.opened else {
            return Ok(());
        };
        let PhysicalSize { width, height } = self.size;
        let (Some(width), Some(height)) = (NonZeroU32::new(width), NonZeroU32::new(height)) else {
            return Ok(());
        };
        // The fonts are made of pixels: on a finer display, each of ours takes several of its own.
        let fine = window.scale_factor().round().max(1.0) as u32;
        let size = [width.get().div_ceil(fine), height.get().div_ceil(fine)];
        let settled = self.resized.is_none_or(|since| since.elapsed() >= SETTLED);
        if settled && picture(size) != self.camera.size() {
            self.camera.resize(picture(size))?;
        }
        if self.canvas.size() != size {
            self.canvas = Canvas::new(size[0], size[1]);
        }
        let title = draw(self.show, self.texts, &mut self.camera, &mut self.canvas)?;
        if title != self.title {
            window.set_title(&title);
            self.title = title;
        }
        pixels.resize(width, height).map_err(no_window)?;
        let mut buffer = pixels.buffer_mut().map_err(no_window)?;
        let rows = buffer.chunks_exact_mut(width.get() as usize);
        for (y, row) in (0..).zip(rows) {
            for (x, pixel) in (0..).zip(row) {
                *pixel = self.canvas.pixel(x / fine, y / fine);
            }
        }
        window.pre_present_notify();
        buffer.present().map_err(no_window)
    }

    fn key(&mut self, key: &Key, events: &ActiveEventLoop) {
        match key.as_ref() {
            Key::Named(NamedKey::Space) | Key::Character(" ") => {
                self.show.ask(|request| request.paused = !request.paused);
            }
            Key::Character("." | ">") | Key::Named(NamedKey::ArrowRight) => {
                self.show.ask(|request| {
                    request.single += u32::from(request.paused);
                    request.paused = true;
                });
            }
            Key::Character("+" | "=") => self.show.ask(|request| request.pace.change(1)),
            Key::Character("-") => self.show.ask(|request| request.pace.change(-1)),
            Key::Character("r" | "R") => self.show.ask(|request| request.restart = true),
            Key::Character("q" | "Q") | Key::Named(NamedKey::Escape) => events.exit(),
            _ => {}
        }
    }

    fn moved(&mut self, to: PhysicalPosition<f64>, height: u32) {
        let way = [to.x - self.mouse.at.x, to.y - self.mouse.at.y];
        self.mouse.at = to;
        if let Some(motion) = self.mouse.motion() {
            self.camera
                .steer(motion, way.map(|pixels| pixels / f64::from(height.max(1))));
        }
    }
}

/// Draws picture and captions; returns the window's title.
fn draw(
    show: &Show<'_>,
    texts: &Texts,
    camera: &mut Camera,
    canvas: &mut Canvas,
) -> Result<String, ViewerError> {
    let mut shown = show.now();
    let Some(phase) = shown.phase else {
        return Ok("lads".to_owned());
    };
    camera.see(&mut shown.data)?;
    let instructions = &mut texts.instructions.iter();
    let known = instructions.find(|(index, _)| *index == shown.instruction);
    let text = known.map_or("", |(_, text)| text);
    let (request, plans) = (shown.request, shown.plans.clone());
    let (completions, commanded) = (shown.completions.clone(), shown.commanded.clone());
    let (episode, steps) = (shown.episode + 1, shown.max_steps);
    // Episodes go on while the picture is drawn.
    drop(shown);
    let speed = request.pace.speed();
    let pace = if request.paused {
        "paused".to_owned()
    } else {
        format!("{speed} x real time")
    };
    let note = format!("episode {episode} of {}  {pace}", texts.episodes);
    let width = camera.size()[0];
    canvas.clear();
    canvas.paste(camera.draw()?, width, 0, caption::HEAD);
    let caption = Caption {
        instruction: text,
        sub_tasks: texts.sub_tasks,
        commanded: &commanded,
        steps,
        period_s: texts.period_s,
        note: &note,
    };
    let progress = Progress {
        plans: &plans,
        completions: &completions,
        phase,
    };
    let bottom = canvas.size()[1].saturating_sub(caption::LINE_HEIGHT);
    caption.draw(progress, bottom, canvas);
    caption::line(HELP, bottom, canvas);
    Ok(format!("lads: {text}"))
}

impl ApplicationHandler<()> for Screen<'_> {
    fn resumed(&mut self, events: &ActiveEventLoop) {
        if self.opened.is_none() {
            match self.open(events) {
                Ok(()) => self.show.ask(|request| request.window = show::Window::Open),
                Err(error) => {
                    self.failed = Some(error);
                    events.exit();
                }
            }
        }
    }

    fn new_events(&mut self, events: &ActiveEventLoop, cause: StartCause) {
        if let StartCause::ResumeTimeReached { .. } = cause {
            events.set_control_flow(ControlFlow::Wait);
            self.user_event(events, ());
        }
    }

    fn user_event(&mut self, events: &ActiveEventLoop, (): ()) {
        if self.done.load(Ordering::Relaxed) {
            events.exit();
        } else if let Some((window, _)) = &self.opened {
            window.request_redraw();
        }
    }

    fn window_event(&mut self, events: &ActiveEventLoop, _: WindowId, event: WindowEvent) {
        let height = self.camera.size()[1];
        match event {
            WindowEvent::CloseRequested | WindowEvent::Destroyed => return events.exit(),
            WindowEvent::RedrawRequested => {
                if let Err(error) = self.draw() {
                    self.failed = Some(error);
                    events.exit();
                }
                return;
            }
            WindowEvent::Resized(size) => {
                self.size = size;
                let now = Instant::now();
                self.resized = Some(now);
                events.set_control_flow(ControlFlow::WaitUntil(now + SETTLED));
            }
            WindowEvent::ModifiersChanged(keys) => self.mouse.keys = keys.state(),
            WindowEvent::KeyboardInput { event, .. } if event.state == ElementState::Pressed => {
                self.key(&event.logical_key, events);
            }
            WindowEvent::MouseInput { state, button, .. } => {
                let pressed = state == ElementState::Pressed;
                self.mouse.pressed = pressed.then_some(button);
                return;
            }
            WindowEvent::CursorMoved { position, .. } => {
                self.moved(position, height);
                if self.mouse.pressed.is_none() {
                    return;
                }
            }
            WindowEvent::MouseWheel { delta, .. } => {
                let nearer = match delta {
                    MouseScrollDelta::LineDelta(_, lines) => NOTCH * f64::from(lines),
                    MouseScrollDelta::PixelDelta(way) => TOUCH * way.y,
                };
                self.camera.steer(Motion::Zoom, [0.0, -nearer]);
            }
            _ => return,
        }
        self.user_event(events, ());
    }
}
