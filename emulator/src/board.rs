//! The NUCLEO-F429ZI as the emulator builds it: the part, its crystal's clock, its supply, and what hangs on its pins.

use std::num::{NonZeroU32, NonZeroU64};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};

use anyhow::{Context, ensure};
use rigless::chip::Timeline;
use rigless::chip::uart::{Errors, Peer};
use rigless::cpu::armv7m::windows;
use rigless::device::{Device, Level};
use rigless::machine::{Board, Crystal, Supply, Target, armv7m};
use rigless::mcu::{Mcu, Operate};
use rigless::snapshot::Store;
use rigless::soc::Error;
use rigless::soc::stm32f427::Stm32f427;
use rigless::soc::stm32f427::generated::rcc::{Register as Rcc, cir, cr};
use rigless::soc::stm32f427::generated::tim2::Register as Tim2;
use rigless::soc::stm32f427::generated::usart6::{Register as Usart, cr3};
use rigless::soc::stm32f427::peripherals::gpio::Pin;
use rigless::time::VirtualNanos;

use crate::nmi;
use crate::paced::Pace;
use crate::room::Room;

/// What the simulation and the chips on the board share.
pub type Shared = Arc<Mutex<Room>>;

/// At its fastest.
pub const CLOCK_HZ: NonZeroU64 = NonZeroU64::new(180_000_000).expect("not zero");
/// Cycles of each instruction of a board without a pace: the average by the model in [`crate::cycles`], which
/// [`check_assumed_cycles`] holds it against.
pub const CYCLES_PER_INSTRUCTION: f64 = 1.84;
/// How far it may be from what is counted, as a share.
const CYCLES_TOLERANCE: f64 = 0.1;
const INSTRUCTIONS_PER_SECOND: NonZeroU64 =
    NonZeroU64::new((CLOCK_HZ.get() as f64 / CYCLES_PER_INSTRUCTION) as u64).expect("not zero");
const REFCLK_DIVIDER: NonZeroU32 = NonZeroU32::new(8).expect("not zero");

/// USART6 among the part's serial ports, USART3 beside it.
const URG_PORT: usize = 3;
const VCP_PORT: usize = 2;
/// TIM2, TIM3 and TIM4 among the part's timers.
const TIME_DRIVER: usize = 0;
const RIGHT: usize = 1;
const LEFT: usize = 2;
/// Ports B and C.
const LED: (usize, u8) = (1, 0);
const BUTTON: (usize, u8) = (2, 13);

/// `EGR` of TIM2, where the time driver asks for an update.
pub const TIME_DRIVER_EGR: u64 = 0x4000_0014;
/// `ACR` of the flash.
pub const FLASH_ACR: u64 = 0x4002_3C00;
/// Its bits that turn on reading ahead and keeping code and constants.
pub const FLASH_ACCELERATED: u64 = 0b111 << 8;
/// `CR` of the clock controller.
pub const RCC_CR: u64 = 0x4002_3800;
/// The debug unit's bits that stop timers and watchdogs while a debugger holds the core.
pub const DBGMCU_APB1_FZ: u64 = 0xE004_2008;
/// The mask of the external interrupts, and the bit of the voltage detector's line.
pub const EXTI_IMR: (u64, u64) = (0x4001_3C00, 1 << 16);
/// `BRR` of USART6.
pub const URG_BRR: u64 = 0x4001_1408;

/// Fails where the average that the model counted is far from [`CYCLES_PER_INSTRUCTION`].
pub fn check_assumed_cycles(counted: f64) -> anyhow::Result<()> {
    ensure!(
        (counted / CYCLES_PER_INSTRUCTION - 1.0).abs() <= CYCLES_TOLERANCE,
        "an instruction takes {counted:.2} cycles here; the emulated board assumes {CYCLES_PER_INSTRUCTION}"
    );
    Ok(())
}

/// The board.
#[derive(Debug)]
pub struct Nucleo {
    /// The microcontroller: an STM32F427, which has all that the firmware uses of the STM32F429.
    pub mcu: Stm32f427,
    instructions_per_second: NonZeroU64,
    pace: Option<Pace>,
    /// The ST-LINK gives no clock.
    hse_dead: bool,
    /// Raised by the clock security system.
    nmi: Arc<AtomicBool>,
    /// The voltage detector's interrupt is on.
    pub pvd_armed: bool,
}

impl Nucleo {
    /// The microcontroller alone, with so many instructions a second, or cycles with a pace.
    pub fn bare(per_second: u64, pace: Option<Pace>) -> anyhow::Result<Self> {
        let instructions_per_second = NonZeroU64::new(per_second).context("a core that stands")?;
        let mut mcu = Stm32f427::new()?;
        mcu.set_supply(Supply(3300).0);
        Ok(Self {
            mcu,
            instructions_per_second,
            pace,
            hse_dead: false,
            nmi: Arc::default(),
            pvd_armed: false,
        })
    }

    /// Powered and wired, not yet running. Without a pace each instruction takes as long as the next.
    pub fn new(shared: Shared, pace: Option<Pace>) -> Result<Self, Error> {
        let instructions_per_second = if pace.is_some() { CLOCK_HZ } else { INSTRUCTIONS_PER_SECOND };
        let mut board = Self {
            mcu: Stm32f427::new()?,
            instructions_per_second,
            pace,
            hse_dead: false,
            nmi: Arc::default(),
            pvd_armed: false,
        };
        board.mcu.rcc.attach_crystals(8_000_000, Crystal::NONE.0);
        board.mcu.set_supply(Supply(3300).0);
        board.mcu.usart[URG_PORT].attach(Urg { shared: shared.clone() });
        board.mcu.usart[VCP_PORT].attach(Vcp { shared });
        Ok(board)
    }

    /// Garbles so many in a million of the bytes that arrive: noise, and framing errors.
    pub fn set_line_errors(&mut self, noise: u32, framing: u32, seed: u64) {
        let errors = self.mcu.usart[URG_PORT].errors_mut();
        errors.seed = seed;
        (errors.noise.name, errors.noise.per_million) = ("urg.noise", noise);
        (errors.framing.name, errors.framing.per_million) = ("urg.framing", framing);
    }

    /// Has the ST-LINK give no clock.
    pub fn kill_hse(&mut self) {
        self.mcu.rcc.attach_crystals(0, Crystal::NONE.0);
        self.hse_dead = true;
    }

    /// Stops the ST-LINK's clock while the part runs. Where the clock security system watches, the part goes over to its own
    /// oscillator and has a non-maskable interrupt, which the part's model leaves out.
    pub fn stop_hse(&mut self, at: VirtualNanos) {
        self.mcu.drive_clocks(at, |rcc, registers, context| rcc.fail_hse(registers, context));
        let (_, registers) = self.mcu.clocks();
        self.nmi.store(cir::CSSF.is_set(registers.get(Rcc::Cir)), Ordering::Relaxed);
        self.kill_hse();
    }

    /// Undoes what the clock controller's model does and the silicon does not: it says that an oscillator is ready with nothing
    /// on its pins. To be called after each write to its `CR`.
    pub fn hold_hse(&mut self, at: VirtualNanos) {
        if !self.hse_dead {
            return;
        }
        self.mcu.drive_clocks(at, |rcc, registers, context| {
            let off = cr::HSEON.set(registers.get(Rcc::Cr), 0);
            registers.set(Rcc::Cr, off);
            rcc.write(Rcc::Cr, off, registers, context);
        });
    }

    /// One byte in so many that arrive comes with noise, as the errors that this returns draw it.
    pub fn set_noise(&mut self, one_in: u32, seed: u64) -> Errors {
        let errors = self.mcu.usart[URG_PORT].errors_mut();
        errors.seed = seed;
        (errors.noise.name, errors.noise.per_million) = ("urg.noise", 1_000_000 / one_in.max(1));
        *errors
    }

    /// Has the port sample each bit three times, whatever the firmware wants: noise raises its flag then, as noise on a start bit does
    /// on the silicon with one sample for a bit too.
    pub fn sample_three_times(&mut self) {
        let (_, registers) = self.mcu.serial_port(URG_PORT);
        let value = registers.get(Usart::Cr3);
        registers.set(Usart::Cr3, cr3::ONEBIT.set(value, 0));
    }

    /// Holds up the DMA that receives, or lets it go on.
    pub fn hold_dma(&mut self, at: VirtualNanos, held: bool) {
        self.mcu.drive_serial_port(at, URG_PORT, |port, registers, context| {
            let value = cr3::DMAR.set(registers.get(Usart::Cr3), u64::from(!held));
            registers.set(Usart::Cr3, value);
            Device::write(port, Usart::Cr3, value, registers, context);
        });
    }

    /// Levels of an encoder's two lines, for the left and the right wheel.
    pub fn drive_encoder(&mut self, at: VirtualNanos, side: usize, [a, b]: [Level; 2]) {
        use rigless::soc::stm32f427::peripherals::tim::Channel;
        let timer = if side == 0 { LEFT } else { RIGHT };
        self.mcu.drive_timer(at, timer, |tim, registers, context| {
            for (number, level) in [(1, a), (2, b)] {
                if let Some(channel) = Channel::new(number) {
                    tim.drive_input(channel, level, registers, context);
                }
            }
        });
    }

    /// Presses or releases the user button.
    pub fn press(&mut self, at: VirtualNanos, pressed: bool) {
        let level = if pressed { Level::High } else { Level::Low };
        let Some(pin) = Pin::new(BUTTON.1) else { return };
        self.mcu.drive_port(at, BUTTON.0, |port, registers, context| {
            port.drive(pin, Some(level), registers, context);
        });
    }

    /// Whether the LED is lit.
    pub fn led(&mut self) -> bool {
        let Some(pin) = Pin::new(LED.1) else { return false };
        let (port, registers) = self.mcu.port(LED.0);
        port.level(pin, registers) == Level::High
    }

    /// The bit rate that a divider written to USART6 makes.
    pub fn urg_baud_rate(&mut self, divider: u64) -> u32 {
        let (rcc, registers) = self.mcu.clocks();
        let clock_hz = rcc.pclk2(registers);
        (clock_hz / divider.max(1)) as u32
    }

    /// Undoes what the timer's model does and the silicon does not: an update by software with the counter standing at
    /// a compare value raises the compare flag. The time driver's period count would begin half a period ahead.
    pub fn clear_time_driver_flags(&mut self) {
        let (_, registers) = self.mcu.timer(TIME_DRIVER);
        registers.set(Tim2::Sr, 0);
    }
}

impl Store for Nucleo {}

impl Board for Nucleo {
    fn name(&self) -> &'static str {
        "nucleo-f429zi"
    }

    fn target_names(&self) -> Vec<&'static str> {
        vec!["stm32f429zi"]
    }

    fn mcu(&mut self, target: usize) -> Option<&mut dyn Mcu> {
        (target == 0).then_some(&mut self.mcu)
    }

    fn targets(&mut self) -> Vec<Target<'_>> {
        let lines = NonZeroU32::new(u32::from(Operate::cpu(&self.mcu).interrupt_lines));
        let core = armv7m::Core {
            variant: armv7m::Variant::M4,
            clock_hz: CLOCK_HZ,
            interrupt_lines: lines.expect("the part has interrupts"),
            priority_bits: 4,
            refclk_divider: REFCLK_DIVIDER,
            instructions_per_second: self.instructions_per_second,
            boot: "flash",
        };
        let core = core.spec_with_parts(
            &windows(Mcu::bus(&self.mcu)),
            armv7m::Fpu::FpV4Sp,
            armv7m::MpuRegions::Eight,
        );
        let core = nmi::wire(core, self.nmi.clone());
        let core = match &self.pace {
            Some(pace) => pace.apply(core),
            None => core,
        };
        vec![Target::new("stm32f429zi", &mut self.mcu, core)]
    }
}

/// The sensor on USART6.
#[derive(Debug)]
struct Urg {
    shared: Shared,
}

impl Store for Urg {}

impl Peer for Urg {
    fn receive(&mut self, word: u16, context: &mut Timeline<'_, '_>) {
        let now_us = context.now().0 / 1000;
        if let Ok(mut room) = self.shared.lock() {
            room.to_sensor(word as u8, now_us);
        }
    }

    fn transmit(&mut self, now: VirtualNanos) -> Option<u16> {
        self.shared.lock().ok()?.from_sensor(now.0 / 1000).map(u16::from)
    }
}

/// The other end of the virtual COM port.
#[derive(Debug)]
struct Vcp {
    shared: Shared,
}

impl Store for Vcp {}

impl Peer for Vcp {
    fn receive(&mut self, word: u16, context: &mut Timeline<'_, '_>) {
        let now_us = context.now().0 / 1000;
        if let Ok(mut room) = self.shared.lock() {
            room.vcp.take(word as u8, now_us);
        }
    }

    fn transmit(&mut self, _: VirtualNanos) -> Option<u16> {
        self.shared.lock().ok()?.vcp.to_board.pop_front().map(u16::from)
    }
}
