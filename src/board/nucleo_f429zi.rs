//! NUCLEO-F429ZI. The wiring is drawn in the README.
//!
//! | what | pins | header |
//! |---|---|---|
//! | URG, USART6 through a level shifter | PG9 receives, PG14 transmits | CN10-16 (D0), CN10-14 (D1) |
//! | left encoder, TIM4 | PD12 A, PD13 B | CN10-21 (D29), CN10-19 (D28) |
//! | right encoder, TIM3 | PC6 A, PC7 B | CN7-1 (D16), CN7-11 (D21) |
//! | link, USART3 | PD9 receives, PD8 transmits | the ST-LINK's virtual COM port |
//! | user LED, user button | PB0, PC13 | on the board |

use embassy_executor::{InterruptExecutor, SendSpawner};
use embassy_stm32::gpio::{Input, Level, Output, Pull, Speed};
use embassy_stm32::interrupt;
use embassy_stm32::interrupt::{InterruptExt, Priority};
use embassy_stm32::mode::Async;
use embassy_stm32::usart::{self, RingBufferedUartRx, RxDma, Uart, UartTx};
use embassy_stm32::wdg::IndependentWatchdog;
use embassy_stm32::{Peri, bind_interrupts, dma, pac, peripherals};
use static_cell::StaticCell;

use super::receiver::{AfterPort, BeforePort, BeforeRing, RING, Receiver};

mod clocks;
mod encoders;
pub mod supply;

pub use clocks::{CORE_HZ, ClockSource};
pub use encoders::EncoderPins;

/// For the boot banner.
pub const NAME: &str = "NUCLEO-F429ZI";

/// Runs what must not wait for the map, on an interrupt: UART5's, for which the board has no other use.
static URGENT: InterruptExecutor = InterruptExecutor::new();

#[interrupt]
unsafe fn UART5() {
    // SAFETY: this is the executor's interrupt, and only it calls this.
    crate::measure::urgent(|| crate::stack::watched(|| unsafe { URGENT.on_interrupt() }))
}

/// Starts the executor of what must not wait for the map. To be called once.
pub fn urgent() -> SendSpawner {
    URGENT.start(interrupt::UART5)
}

/// The scanner's port, and the DMA stream that receives from it.
pub(super) const LIDAR_USART: pac::usart::Usart = pac::USART6;
pub(super) const LIDAR_STREAM: (pac::dma::Dma, usize) = (pac::DMA2, 1);

/// The same for the link: a few requests, which wait here while the map is worked on.
const VCP_RING: usize = 128;

bind_interrupts!(struct Irqs {
    USART6 => BeforePort, usart::InterruptHandler<peripherals::USART6>, AfterPort;
    USART3 => usart::InterruptHandler<peripherals::USART3>;
    DMA2_STREAM1 => BeforeRing, dma::InterruptHandler<peripherals::DMA2_CH1>;
    DMA2_STREAM6 => dma::InterruptHandler<peripherals::DMA2_CH6>;
    DMA1_STREAM1 => dma::InterruptHandler<peripherals::DMA1_CH1>;
    DMA1_STREAM3 => dma::InterruptHandler<peripherals::DMA1_CH3>;
});

/// What the board has, each part to be handed to the task that uses it.
pub struct Board {
    /// The scanner's port.
    pub lidar: LidarPins,
    /// The encoders' timers.
    pub encoders: EncoderPins,
    /// The virtual COM port.
    pub vcp: VcpPins,
    /// Shows that the firmware lives.
    pub led: Output<'static>,
    /// High while pressed.
    pub button: Input<'static>,
}

/// Resets the board unless it is fed.
pub type Watchdog = IndependentWatchdog<'static, peripherals::IWDG>;

/// Pins and DMA channels of the scanner's port.
pub struct LidarPins {
    usart: Peri<'static, peripherals::USART6>,
    rx: Peri<'static, peripherals::PG9>,
    tx: Peri<'static, peripherals::PG14>,
    rx_dma: Peri<'static, peripherals::DMA2_CH1>,
    tx_dma: Peri<'static, peripherals::DMA2_CH6>,
}

/// Pins and DMA channels of the virtual COM port.
pub struct VcpPins {
    usart: Peri<'static, peripherals::USART3>,
    rx: Peri<'static, peripherals::PD9>,
    tx: Peri<'static, peripherals::PD8>,
    rx_dma: Peri<'static, peripherals::DMA1_CH1>,
    tx_dma: Peri<'static, peripherals::DMA1_CH3>,
}

/// Why the board started.
#[derive(Clone, Copy, Debug, PartialEq, Eq, defmt::Format)]
pub enum ResetCause {
    /// Power came, or had fallen too low.
    Power,
    /// The independent watchdog was not fed.
    Watchdog,
    /// The firmware asked for it: a panic or a fault.
    Software,
    /// The reset pin.
    Pin,
    /// Anything else.
    Other,
}

/// Starts the watchdog, which runs on an oscillator of its own, and stops it and the timers while a debugger holds the core. To be
/// called once, before anything that could hang.
pub fn guard(unfed_us: u32) -> Watchdog {
    pac::DBGMCU.apb1fzr().modify(|w| {
        w.set_iwdg(true);
        w.set_wwdg(true);
        w.set_tim2(true);
        w.set_tim3(true);
        w.set_tim4(true);
    });
    // SAFETY: the HAL hands out its peripherals when it starts, which is later; the one of the watchdog is left there.
    let mut watchdog = IndependentWatchdog::new(unsafe { peripherals::IWDG::steal() }, unfed_us);
    watchdog.unleash();
    if let Some(mut core) = cortex_m::Peripherals::take() {
        core.DCB.enable_trace();
        core.DWT.enable_cycle_counter();
    }
    watchdog
}

/// Clocks, pins, interrupts. To be called once. `external_clock` says whether the ST-LINK's clock may be taken.
pub fn start(external_clock: bool) -> (Board, ClockSource) {
    let clock = ClockSource::choose(external_clock);
    let p = embassy_stm32::init(clock.config());
    clock.guard();
    accelerate_flash();
    supply::watch();
    // The firmware's own urgent work comes after what the hardware cannot hold back, bytes and time.
    interrupt::UART5.set_priority(Priority::P6);
    let board = Board {
        lidar: LidarPins { usart: p.USART6, rx: p.PG9, tx: p.PG14, rx_dma: p.DMA2_CH1, tx_dma: p.DMA2_CH6 },
        encoders: EncoderPins {
            left: p.TIM4,
            left_a: p.PD12,
            left_b: p.PD13,
            right: p.TIM3,
            right_a: p.PC6,
            right_b: p.PC7,
        },
        vcp: VcpPins { usart: p.USART3, rx: p.PD9, tx: p.PD8, rx_dma: p.DMA1_CH1, tx_dma: p.DMA1_CH3 },
        led: Output::new(p.PB0, Level::Low, Speed::Low),
        // The board has a pull-down resistor.
        button: Input::new(p.PC13, Pull::None),
    };
    (board, clock)
}

/// Has code and constants read ahead and kept: at 180 MHz the flash makes the core wait five cycles for each 16 bytes that it
/// has not. Setting the clocks leaves the accelerator off.
fn accelerate_flash() {
    pac::FLASH.acr().modify(|w| {
        w.set_prften(true);
        w.set_icen(true);
        w.set_dcen(true);
    });
}

/// Reads the reset flags and clears them for the next time. A power-up sets the pin's flag too.
pub fn reset_cause() -> ResetCause {
    let flags = pac::RCC.csr().read();
    pac::RCC.csr().modify(|w| w.set_rmvf(true));
    if flags.porrstf() || flags.borrstf() {
        ResetCause::Power
    } else if flags.wdgrstf() {
        ResetCause::Watchdog
    } else if flags.sftrstf() {
        ResetCause::Software
    } else if flags.padrstf() {
        ResetCause::Pin
    } else {
        ResetCause::Other
    }
}

/// The scanner's port: DMA both ways, the receiver into a ring.
pub struct LidarPort {
    tx: UartTx<'static, Async>,
    rx: Receiver,
}

impl LidarPins {
    /// Opens the port. `None` if the bit rate cannot be made, which it can.
    pub fn open(self) -> Option<LidarPort> {
        static BUFFER: StaticCell<[u8; RING]> = StaticCell::new();
        let mut config = usart::Config::default();
        // One sample for a bit and not the majority of three: a glitch beside it raises no flag, and the rates of both ends may be
        // farther apart, as on the internal oscillator.
        config.assume_noise_free = true;
        // A plug that is pulled leaves the line at rest, and not an antenna.
        config.rx_pull = Pull::Up;
        let request = RxDma::<peripherals::USART6>::request(&*self.rx_dma);
        // SAFETY: the port gets the channel too, but uses it only in functions that the receiver does not call.
        let channel = unsafe { self.rx_dma.clone_unchecked() };
        let uart = Uart::new(self.usart, self.rx, self.tx, self.tx_dma, self.rx_dma, Irqs, config);
        let (tx, rx) = uart.ok()?.split();
        let channel = dma::Channel::new(channel, Irqs);
        // SAFETY: the channel is the port's, see above, and the request that of its receiver.
        let rx = unsafe { Receiver::new(rx, channel, request, BUFFER.init([0; RING])) };
        Some(LidarPort { tx, rx })
    }
}

impl embedded_io_async::ErrorType for LidarPort {
    type Error = usart::Error;
}

impl embedded_io_async::Read for LidarPort {
    async fn read(&mut self, buffer: &mut [u8]) -> Result<usize, usart::Error> {
        self.rx.read(buffer).await
    }
}

impl embedded_io_async::Write for LidarPort {
    async fn write(&mut self, bytes: &[u8]) -> Result<usize, usart::Error> {
        self.tx.write(bytes).await?;
        Ok(bytes.len())
    }

    async fn flush(&mut self) -> Result<(), usart::Error> {
        self.tx.flush().await
    }
}

impl scip::SerialPort for LidarPort {
    fn set_baud_rate(&mut self, bits_per_second: u32) -> Result<(), usart::Error> {
        // A rate that the divider cannot make stays as it was; the search goes on at the next.
        match self.rx.set_baud_rate(bits_per_second) {
            Ok(()) => Ok(()),
            Err(error) => {
                defmt::warn!("{=u32} bit/s cannot be made: {}", bits_per_second, error);
                Ok(())
            }
        }
    }
}

impl VcpPins {
    /// Opens the port at the link's bit rate: 918 367 bit/s, 0.4 % less than asked for. `None` if that cannot be made, which it can.
    pub fn open(self) -> Option<(UartTx<'static, Async>, RingBufferedUartRx<'static>)> {
        static BUFFER: StaticCell<[u8; VCP_RING]> = StaticCell::new();
        let mut config = usart::Config::default();
        config.baudrate = ::link::BIT_RATE;
        let uart = Uart::new(self.usart, self.rx, self.tx, self.tx_dma, self.rx_dma, Irqs, config);
        let (tx, rx) = uart.ok()?.split();
        Some((tx, rx.into_ring_buffered(BUFFER.init([0; VCP_RING]))))
    }
}
