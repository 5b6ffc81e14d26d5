/**
 * lads.hpp: the C interface of lads.h for C++17. Header only; throws nothing, needs neither exceptions nor RTTI.
 *
 * A Policy is a checked view on an image; a Controller owns its workspace, or works in memory that it is lent. Nothing allocates
 * except Controller::allocate, which is called once, before the loop. Neither can be copied or moved.
 *
 *     lads::Policy policy;
 *     if (auto status = policy.open(image); !status) return fail(status.text());
 *     lads::Controller controller;
 *     if (auto status = controller.allocate(policy); !status) ...
 *     if (auto status = controller.self_test(); !status) ...      // arms
 *     controller.set_instruction("mkbh");
 *     auto status = controller.step(observation, action, tick);   // every control period: from a controller that is
 *                                                                 // set up, into an action of the contract's length, `action`
 *                                                                 // may be executed, whatever the status
 *
 * Structs that begin with struct_bytes are made with lads::made<lads_options>(), which sets it.
 */
#ifndef LADS_HPP
#define LADS_HPP

#include <cstddef>
#include <cstdint>
#include <new>
#include <string_view>
#include <type_traits>
#include <utility>

#include "lads.h"

namespace lads {

/** A view on elements that another object owns; made from anything with data() and size(), or from an array. */
template <typename T>
class Span {
public:
    constexpr Span() noexcept = default;
    constexpr Span(T *data, std::size_t size) noexcept : data_(data), size_(size) {}
    template <std::size_t N>
    constexpr Span(T (&array)[N]) noexcept : data_(array), size_(N) {}
    template <typename C, typename = std::enable_if_t<std::is_convertible_v<
                              std::remove_pointer_t<decltype(std::declval<C &>().data())> (*)[], T (*)[]>>>
    constexpr Span(C &&container) noexcept : data_(container.data()), size_(container.size()) {}

    constexpr T *data() const noexcept { return data_; }
    constexpr std::size_t size() const noexcept { return size_; }
    constexpr T *begin() const noexcept { return data_; }
    constexpr T *end() const noexcept { return data_ + size_; }
    constexpr T &operator[](std::size_t index) const noexcept { return data_[index]; }

private:
    T *data_ = nullptr;
    std::size_t size_ = 0;
};

/** Result of a call, which converts to true for success. */
class [[nodiscard]] Status {
public:
    constexpr Status(lads_status code = LADS_STATUS_OK) noexcept : code_(code) {}
    constexpr explicit operator bool() const noexcept { return code_ == LADS_STATUS_OK; }
    constexpr lads_status code() const noexcept { return code_; }
    const char *text() const noexcept { return lads_status_text(code_); }
    friend constexpr bool operator==(Status a, Status b) noexcept { return a.code_ == b.code_; }
    friend constexpr bool operator!=(Status a, Status b) noexcept { return !(a == b); }

private:
    lads_status code_;
};

/** Makes a struct of lads.h, all zero but its size. */
template <typename T>
constexpr T made() noexcept {
    T value{};
    value.struct_bytes = sizeof(T);
    return value;
}

/** Makes the clock of a control period. */
inline lads_tick tick(std::uint64_t timestamp, std::uint32_t missed = 0) noexcept {
    auto tick = made<lads_tick>();
    tick.timestamp = timestamp;
    tick.missed = missed;
    return tick;
}

/** Makes the input of a channel from contiguous values; row_bytes as in lads_input. */
inline lads_input input(std::uint32_t channel, Span<const float> values, std::size_t row_bytes = 0) noexcept {
    return {channel, LADS_F32, values.data(), values.size(), row_bytes};
}
inline lads_input input(std::uint32_t channel, Span<const std::uint8_t> values, std::size_t row_bytes = 0) noexcept {
    return {channel, LADS_U8, values.data(), values.size(), row_bytes};
}
inline lads_input input(std::uint32_t channel, Span<const std::int32_t> values, std::size_t row_bytes = 0) noexcept {
    return {channel, LADS_I32, values.data(), values.size(), row_bytes};
}

/** Returns a text inside the image as a string view. */
inline std::string_view view(lads_text text) noexcept { return {text.data, text.len}; }

/** A checked view on an image, which has to outlive it. */
class Policy {
public:
    Policy() noexcept = default;
    Policy(const Policy &) = delete;
    Policy &operator=(const Policy &) = delete;

    Status open(Span<const std::uint8_t> image) noexcept {
        contract_ = made<lads_contract>();
        const Status status = lads_policy_open(image.data(), image.size(), &policy_);
        return status ? Status(lads_policy_contract(&policy_, &contract_)) : status;
    }

    const lads_contract &contract() const noexcept { return contract_; }
    std::size_t workspace_bytes() const noexcept { return lads_workspace_bytes(&policy_); }
    const lads_policy *get() const noexcept { return &policy_; }

    std::uint32_t channel_count() const noexcept { return lads_channel_count(&policy_); }
    Status channel(std::uint32_t number, lads_channel_t &channel) const noexcept {
        channel = made<lads_channel_t>();
        return lads_channel(&policy_, number, &channel);
    }
    /** Finds the number of a channel by its name, byte for byte. */
    Status find_channel(std::string_view name, std::uint32_t &number) const noexcept {
        return lads_channel_find(&policy_, name.data(), name.size(), &number);
    }
    Status element(std::uint32_t channel, std::size_t index, lads_element &element) const noexcept {
        element = made<lads_element>();
        return lads_channel_element(&policy_, channel, index, &element);
    }
    /** Describes element `index` of the first observation channel, the only one of most policies. */
    Status observation(std::size_t index, lads_element &element) const noexcept {
        return this->element(contract_.observation, index, element);
    }
    Status action(std::size_t index, lads_element &element) const noexcept {
        return this->element(contract_.action, index, element);
    }
    Status instruction(std::uint32_t number, lads_instruction &known) const noexcept {
        known = made<lads_instruction>();
        return lads_policy_instruction(&policy_, number, &known);
    }
    /** Finds the number of an instruction by id, or by text up to the case of ASCII letters and white space. */
    Status find_instruction(std::string_view name, std::uint32_t &number) const noexcept {
        return lads_policy_find_instruction(&policy_, name.data(), name.size(), &number);
    }
    /** Finds the known instruction that words are most similar to, and the similarity: compare it with contract().acceptance. */
    Status similarity(Span<const float> words, std::uint32_t &number, float &similarity) const noexcept {
        return lads_instruction_similarity(&policy_, words.data(), words.size(), &number, &similarity);
    }

private:
    lads_policy policy_{};
    lads_contract contract_ = made<lads_contract>();
};

/** A controller with its guard. */
class Controller {
public:
    Controller() noexcept = default;
    Controller(const Controller &) = delete;
    Controller &operator=(const Controller &) = delete;
    ~Controller() { release(); }

    /** Allocates a workspace and sets the controller up in it; if that is refused, what ran before runs on. */
    Status allocate(const Policy &policy, const lads_options &options = made<lads_options>(),
                    lads_report *report = nullptr) noexcept {
        const std::size_t bytes = policy.workspace_bytes();
        if (bytes == 0) {
            return LADS_STATUS_NOT_SET_UP;
        }
        void *const owned = ::operator new(bytes, alignment, std::nothrow);
        if (owned == nullptr) {
            return LADS_STATUS_WORKSPACE_TOO_SMALL;
        }
        const Status status = init(policy, owned, owned, bytes, options, report);
        if (!status) {
            ::operator delete(owned, alignment, std::nothrow);
        }
        return status;
    }

    /** Sets the controller up in lent memory, aligned to LADS_WORKSPACE_ALIGN, which has to outlive it; if that is refused, what ran before runs on. */
    Status use(const Policy &policy, void *workspace, std::size_t bytes, const lads_options &options = made<lads_options>(),
               lads_report *report = nullptr) noexcept {
        return init(policy, nullptr, workspace, bytes, options, report);
    }

    /** Replays the recorded episode, and arms if it passes. */
    Status self_test(lads_self_test_t *result = nullptr) noexcept { return lads_self_test(controller_, result); }

    Status set_instruction(std::uint32_t number) noexcept { return lads_set_instruction(controller_, number); }
    Status set_instruction(std::string_view name) noexcept {
        if (policy_ == nullptr) {
            return LADS_STATUS_NULL;
        }
        std::uint32_t number = 0;
        const Status status = policy_->find_instruction(name, number);
        return status ? set_instruction(number) : status;
    }
    Status set_words(Span<const float> words, lads_report *report = nullptr) noexcept {
        return lads_set_words(controller_, words.data(), words.size(), report);
    }
    Status set_decision(float temperature, std::uint64_t seed) noexcept {
        return lads_set_decision(controller_, temperature, seed);
    }
    Status set_noise(std::uint32_t rule, std::uint64_t seed) noexcept { return lads_set_noise(controller_, rule, seed); }

    /** Runs one control period; see lads_step. */
    Status step(Span<const float> observation, Span<float> action, const lads_tick &tick,
                lads_report *report = nullptr) noexcept {
        return lads_step(controller_, observation.data(), observation.size(), &tick, action.data(), action.size(), report);
    }
    /** Runs one control period without a clock: nothing is stale or late. */
    Status step(Span<const float> observation, Span<float> action, lads_report *report = nullptr) noexcept {
        return lads_step(controller_, observation.data(), observation.size(), nullptr, action.data(), action.size(), report);
    }
    /** Runs one control period of any policy; see lads_step_channels. */
    Status step_channels(Span<const lads_input> inputs, Span<float> action, const lads_tick *tick = nullptr,
                         lads_report *report = nullptr) noexcept {
        return lads_step_channels(controller_, inputs.data(), inputs.size(), tick, action.data(), action.size(), report);
    }

    /**
     * Replaces this controller's policy by that of `next`, which was set up, tested and instructed, between two steps; see
     * lads_swap. Afterwards this object is the new controller, and `next` has the old one's memory, to be set up again.
     */
    Status swap(Controller &next, lads_report *report = nullptr) noexcept {
        const Status status = lads_swap(controller_, next.controller_, report);
        if (status) {
            controller_ = next.controller_;
            next.controller_ = nullptr;
            policy_ = next.policy_;
            next.policy_ = nullptr;
            std::swap(owned_, next.owned_);
        }
        return status;
    }

    Status executed(Span<const float> action, lads_report *report = nullptr) noexcept {
        return lads_executed(controller_, action.data(), action.size(), report);
    }
    Status reset() noexcept { return lads_reset(controller_); }
    Status warm() noexcept { return lads_warm(controller_); }
    Status stop() noexcept { return lads_stop(controller_); }
    Status resume() noexcept { return lads_resume(controller_); }
    Status counters(lads_counters_t &counters) noexcept {
        counters = made<lads_counters_t>();
        return lads_counters(controller_, &counters);
    }

    lads_controller *get() noexcept { return controller_; }

private:
    static constexpr std::align_val_t alignment{LADS_WORKSPACE_ALIGN};

    /** What runs is given up only for what has been set up; `owned` is the workspace, or null where it is lent. */
    Status init(const Policy &policy, void *owned, void *workspace, std::size_t bytes, const lads_options &options,
                lads_report *report) noexcept {
        decltype(controller_) made = nullptr;
        const Status status = lads_controller_init(policy.get(), workspace, bytes, &options, &made, report);
        if (status) {
            release();
            controller_ = made;
            owned_ = owned;
            policy_ = &policy;
        }
        return status;
    }

    void release() noexcept {
        controller_ = nullptr;
        policy_ = nullptr;
        if (owned_ != nullptr) {
            ::operator delete(owned_, alignment, std::nothrow);
            owned_ = nullptr;
        }
    }

    void *owned_ = nullptr;
    const Policy *policy_ = nullptr;
    lads_controller *controller_ = nullptr;
};

} // namespace lads

#endif // LADS_HPP
